"""Grids and paths: maps of cells, shortest paths, plans for many robots. Pure."""
