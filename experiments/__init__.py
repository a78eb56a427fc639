"""Ways to run the whole: the single-process loop and presets."""
