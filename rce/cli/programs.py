"""The programs of a server; they report missing packages of the extra ``server``."""

from __future__ import annotations

import sys
from importlib import import_module

from rce.cli.streams import open_missing_streams
from rce.extras import missing_for


def master() -> None:
    """Run ``rce-master``."""
    _run("rce-master", "rce_master")


def robot() -> None:
    """Run ``rce-robot``."""
    _run("rce-robot", "rce_robot")


def container() -> None:
    """Run ``rce-container``."""
    _run("rce-container", "rce_container")


def _run(program: str, package: str) -> None:
    open_missing_streams()
    if problem := missing_for(package):
        sys.exit(f"{program}: {problem}")
    import_module(f"{package}.__main__").main()
