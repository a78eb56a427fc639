"""Owns both networks: mirrors the memory, trains, checkpoints, serves the target network."""
