"""The doors, by which robots connect; see :mod:`rce_robot.doors.base`."""
