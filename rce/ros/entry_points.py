"""Packages and nodes that installed Python distributions add by entry points."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from rce.ros.errors import BadPackageError

if TYPE_CHECKING:
    from collections.abc import Mapping

NODE_ENTRY_POINTS = "rce.nodes"
"""Entry point group by which Python distributions add nodes."""
PACKAGE_ENTRY_POINTS = "rce.packages"
"""Entry point group by which Python distributions add packages."""


@cache
def distributed_packages() -> Mapping[str, str]:
    """Return the packages that Python distributions add: name to Python package."""
    from importlib.metadata import entry_points

    return {point.name: point.value for point in entry_points(group=PACKAGE_ENTRY_POINTS)}


def scripts_of(package: str) -> tuple[tuple[str, str], ...]:
    """Read the executables that Python distributions add to a package: name and ``module[:function]``."""
    return tuple((exe, target) for owner, exe, target in distributed_nodes() if owner == package)


@cache
def distributed_nodes() -> tuple[tuple[str, str, str], ...]:
    """Return the nodes that Python distributions add: package, executable and ``module[:function]``."""
    from importlib.metadata import entry_points

    points = ((*point.name.partition(":"), point.value) for point in entry_points(group=NODE_ENTRY_POINTS))
    return tuple((owner, exe, target) for owner, _, exe, target in points)


def arguments_of(target: str) -> list[str]:
    """Return Python's arguments for running an entry point."""
    module, _, function = target.partition(":")
    if not function:
        return [str(_file_of(target))]
    return ["-c", f"import importlib, sys; sys.exit(importlib.import_module({module!r}).{function}())"]


def folder_of(target: str) -> Path:
    """Return the folder of an entry point's module.

    Raises:
        BadPackageError: There is no such module.
    """
    return _file_of(target).parent


def _file_of(target: str) -> Path:
    module = target.partition(":")[0]
    try:
        spec = find_spec(module)
    except ImportError as error:
        raise BadPackageError(f"entry point {target}: {error}") from error
    if spec is None or spec.origin is None or not spec.has_location:
        raise BadPackageError(f"entry point {target}: there is no file of a module {module}")
    return Path(spec.origin)
