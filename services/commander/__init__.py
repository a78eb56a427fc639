"""Driving without learning: a frozen network or a person commands one robot."""
