"""Which samples go when the memory is full: strategies, listed in `table`."""
