"""Compares ``rce.ros`` with rospy and, if it can be compiled, roscpp."""
