"""A fleet of robots on the engine: planning, coordination, simulation, and the operator's station.

:mod:`rce_fleet.planning`, :mod:`~rce_fleet.coordination`, :mod:`~rce_fleet.navigation` and
:mod:`~rce_fleet.simulation` know neither ROS nor the engine; :mod:`~rce_fleet.nodes` and
:mod:`~rce_fleet.drivers` are ROS nodes around them. Units are SI and radians, counter-clockwise positive.
"""
