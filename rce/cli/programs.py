"""The programs of a server, and the extras that each role needs beside the base.

The base is what a robot needs. ``pyproject.toml`` names the packages of each extra. Programs and commands
report what is missing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec

from rce.own_process import escape_missing_letters, open_missing_streams

SERVER, FLEET, ALL = "server", "fleet", "all"

_MODULES = {
    SERVER: ("aiohttp", "aiosqlite", "argon2", "cryptography", "numpy", "PIL", "prometheus_client", "rich"),
    FLEET: ("aiohttp", "numpy", "PIL", "pymunk", "rosbags", "scipy"),
}
_ROLES = {
    "rce.cli.certificate": SERVER,
    "rce.cli.up": SERVER,
    "rce.cli.service": SERVER,
    "rce_master": SERVER,
    "rce_robot": SERVER,
    "rce_container": SERVER,
    "rce_fleet.demo": ALL,
    "rce_fleet": FLEET,
}
"""Extras of packages; the first one that fits counts."""


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
    escape_missing_letters()
    if problem := missing_for(package):
        sys.exit(f"{program}: {problem}")
    import_module(f"{package}.__main__").main()


def extra_of(module: str) -> str:
    """Return the extra that a module of the project needs; empty for none.

    Example::

        extra_of("rce_master.cli.show")  # "server"
    """
    return next((extra for start, extra in _ROLES.items() if f"{module}.".startswith(f"{start}.")), "")


def missing_for(module: str) -> str | None:
    """Return how to install the missing packages of a module of the project; None if all are installed."""
    extra = extra_of(module)
    parts = (SERVER, FLEET) if extra == ALL else (extra,)
    names = {name for part in parts for name in _MODULES.get(part, ())}
    missing = sorted(name for name in names if find_spec(name) is None)
    if not missing:
        return None
    be = "is" if len(missing) == 1 else "are"
    return f"{', '.join(missing)} {be} not installed: pip install 'rce[{extra}]'"
