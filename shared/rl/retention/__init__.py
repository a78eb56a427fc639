"""Which samples go when the memory is full: one file a strategy, listed in `table`."""
