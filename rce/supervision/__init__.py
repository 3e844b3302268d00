"""Supervision of child programs: start, watch, restart and end them, also if the supervisor is killed."""
