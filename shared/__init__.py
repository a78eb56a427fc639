"""What several services use: messages, keys, configuration, bus; the algorithm in `rl`."""
