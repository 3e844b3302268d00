"""Shared code of the engine's HTTP servers."""
