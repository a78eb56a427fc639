"""The router service: where all other services meet."""
