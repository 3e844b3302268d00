"""Programs that run on the machines of an experiment: sources and listeners of topics, and round trips.

They need nothing but a ROS graph, by rospy or by our nodes: each runs with the system's Python too.
"""
