"""What keeps results with the code and writes the page about them; it needs a checkout."""
