"""The ways by which robots come in; :mod:`rce_robot.doors.base` says what a door is."""
