"""Limits on a process's resources for strangers and users: connections, memory, file descriptors."""
