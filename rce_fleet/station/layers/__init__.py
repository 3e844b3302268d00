"""Layers of the page: a robot's scan, particle cloud, costmaps, path and map."""
