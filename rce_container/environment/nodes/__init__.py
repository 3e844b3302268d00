"""The nodes of a container: what is decided about them, and the processes that they are."""
