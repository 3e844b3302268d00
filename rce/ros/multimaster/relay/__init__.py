"""Passing messages on, their bytes untouched: to another name, another master, or over one connection."""
