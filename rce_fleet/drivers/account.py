"""Who the world is to the engine."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Account:
    """A client of the engine: where the engine is, and as whom to come."""

    url: str
    """The master."""
    user: str
    password: str = field(repr=False)
    robot: str = "world"
    """The robotID by which the world comes."""
