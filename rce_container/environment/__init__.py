"""What runs inside a container: its ROS core, nodes, parameters and interfaces.

It imports little, to start fast.
"""
