"""Command-line tools to inspect and use a ROS graph: topics, services, parameters."""
