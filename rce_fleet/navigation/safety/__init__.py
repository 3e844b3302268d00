"""The stage between planner and wheels: lets pass only speeds from which the robot can stop in time. Pure."""
