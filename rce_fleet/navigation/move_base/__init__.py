"""``move_base``: drives a robot to goals by plans, control and recovery. Pure."""
