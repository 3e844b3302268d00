"""What runs inside a container: its ROS core, its nodes, parameters and interfaces. Imports little, to start fast."""
