"""The ``rce`` program."""

from rce.cli.main import main

__all__ = ["main"]
