"""Bounds for what strangers and users may take of a process: connections, memory, file descriptors."""
