"""The filter of system calls of containers: the allowed calls, and their translation for the kernel."""
