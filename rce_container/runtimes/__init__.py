"""How a container's processes are made: with namespaces, or without any isolation."""
