"""The filter of system calls of containers: what is allowed, and its translation for the kernel."""
