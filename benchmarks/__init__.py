"""Measurements of speed and memory: one script per question, run with `python -m`."""
