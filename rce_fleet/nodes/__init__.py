"""The fleet's ROS nodes: they pass messages to the coordination and from it."""
