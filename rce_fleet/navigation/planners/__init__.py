"""Global and local planners. Pure."""
