"""Exploration of an unknown floor: frontiers of a map, and the choice of the next goal. Pure."""
