"""Owns one robot: observations out, actions in, limits and recovery whatever the network says."""
