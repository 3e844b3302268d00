"""Measures ``rce.ros`` beside rospy and, where it can be compiled against, roscpp."""
