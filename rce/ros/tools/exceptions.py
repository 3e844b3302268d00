"""Errors of the tools."""

from __future__ import annotations


class ToolError(Exception):
    """The command cannot be done; its text says why and what to do."""
