"""The nodes of a container: decisions about them, and their processes."""
