"""Maps from laser scans: logs, trajectories, scan matching, mappers. Pure: neither ROS nor the engine."""
