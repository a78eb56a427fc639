"""Records what the services of a run publish, and reads recordings back."""
