"""Packages that users bring: how they come in and where their contents are kept."""
