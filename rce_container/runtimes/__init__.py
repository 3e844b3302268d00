"""How a container's processes are made: with namespaces, from an image with podman, or without isolation."""
