"""Owns the replay memory, in RAM and on disk: stores, discards, equalises, serves changes."""
