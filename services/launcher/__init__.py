"""`corridor up`: starts all processes, restarts those that crash, shows how the run does."""
