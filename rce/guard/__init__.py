"""Limits on a process's resources for unauthenticated connections and users."""
