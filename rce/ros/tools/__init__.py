"""Look into a ROS graph and take part in it from a command line: topics, services, parameters."""
