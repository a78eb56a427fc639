"""Emulated robots: worlds behind the interfaces of real robots, faults included."""
