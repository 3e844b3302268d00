"""The ``rce`` program, with ``up`` and the commands for secrets, certificates and services."""

from rce.cli.main import main

__all__ = ["main"]
