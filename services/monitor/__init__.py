"""Watching and commanding a run from outside: supervisor, live view, status, operator."""
