"""The ROS nodes: planner, fleet manager, move clients, and the nodes of a robot (``amcl`` ...)."""
