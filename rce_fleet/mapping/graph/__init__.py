"""Graph mapping: a pose graph of keyscans, loop closing, several robots, saved maps. Pure."""
