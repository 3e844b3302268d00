"""From cells to motion: angles, the controller of one robot, occupancy grids. Pure."""
