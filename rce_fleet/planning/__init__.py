"""Maps of cells and lanes, distances, planners for many robots, a checker of plans. Pure."""
