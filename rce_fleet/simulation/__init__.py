"""A simulated world of walls, boxes and differential-drive robots with odometry and lidar."""
