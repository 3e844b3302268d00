"""Simulated robots as ROS nodes: what a real robot would run on its own machine."""
