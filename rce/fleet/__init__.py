"""Fleet algorithms: grid, planners, coordination, navigation, simulated world.

Nothing in here knows ROS, the engine or a socket; node packages and programs wrap it.
Units are SI and radians, counter-clockwise positive.
"""
