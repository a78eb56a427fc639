"""What is known of a world from its map: planner, survey, inspection, pictures."""
