"""The systems by name: those of this package, and those that other distributions add by entry points."""

from __future__ import annotations

from importlib.metadata import entry_points

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.systems.base import System

GROUP = "rce.systems"
"""Entry point group; an entry's name is the system's, and its value the class."""


def system_of(name: str) -> type[System]:
    """Return a system by its name.

    Raises:
        ExperimentError: There is none, or its class is not one.
    """
    points = {point.name: point for point in entry_points(group=GROUP)}
    if name not in points:
        raise ExperimentError(f"there is no system {name}; there is {', '.join(sorted(points))}")
    try:
        found = points[name].load()
    except (ImportError, AttributeError) as error:
        raise ExperimentError(
            f"the system {name} cannot be loaded from {points[name].value}: {error}"
        ) from error
    if not (isinstance(found, type) and issubclass(found, System)):
        raise ExperimentError(f"the system {name}, {points[name].value}, is not a subclass of System")
    return found
