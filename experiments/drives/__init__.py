"""Driving without learning, measured: starts, routes, figures of drives, test drives."""
