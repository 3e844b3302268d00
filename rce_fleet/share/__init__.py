"""The ROS package ``fleet``: its messages and services; its nodes are :mod:`rce_fleet.nodes`."""
