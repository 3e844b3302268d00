"""A fleet of robots on the engine: planning, tasks, navigation, simulation, and the operator's station.

- :mod:`~rce_fleet.planning`, :mod:`~rce_fleet.coordination`, :mod:`~rce_fleet.tasks`,
  :mod:`~rce_fleet.localization`, :mod:`~rce_fleet.mapping`, :mod:`~rce_fleet.navigation` and
  :mod:`~rce_fleet.simulation` know neither ROS nor the engine;
- :mod:`~rce_fleet.nodes` and :mod:`~rce_fleet.drivers` are ROS nodes around them;
- :mod:`~rce_fleet.station` serves page and API, :mod:`~rce_fleet.client` and :mod:`~rce_fleet.cli` use them.

Units are SI and radians, counter-clockwise positive.
"""
