"""Experiments as data: one TOML file for each, and what reads and scales them."""
