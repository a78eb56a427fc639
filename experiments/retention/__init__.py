"""What a memory is worth: strategies manage one stream, and networks learn from what is kept."""
