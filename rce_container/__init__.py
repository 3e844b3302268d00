"""The Container Task Set: makes containers on its machine, watches them and removes them whole."""
