"""Chooses actions, keeps open episodes, computes rewards, hands over to replay."""
