"""The fleet's ROS nodes: they carry messages to the coordination and from it."""
