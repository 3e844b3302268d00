"""Occupancy maps: the grid, ROS's files, distances, ranges. Pure."""
