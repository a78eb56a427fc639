"""A baseline: DQN of Stable-Baselines3 in the same corridors."""
