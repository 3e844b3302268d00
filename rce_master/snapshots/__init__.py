"""Snapshots of volumes, which the masters hold."""
