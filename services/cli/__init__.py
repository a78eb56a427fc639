"""The command line `corridor`, one file for each group of commands."""
