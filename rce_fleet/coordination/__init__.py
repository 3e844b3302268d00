"""Grants cells to robots, so that no two of them ever claim the same one. Pure."""
