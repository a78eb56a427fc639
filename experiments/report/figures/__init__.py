"""Figures of runs, one file per kind; every function returns a matplotlib figure, unwritten."""
