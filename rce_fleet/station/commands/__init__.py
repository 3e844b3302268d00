"""What reaches robots without the planner: emergency stops, velocities by hand, initial poses."""
