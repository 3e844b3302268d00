"""Faults in user input, as data: place, code and text.

Each surface (client protocol, config file, REST API) makes one text of it, by ``str``.
"""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, TypeAlias

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Sequence

Path: TypeAlias = tuple[str | int, ...]
"""Keys and indexes, from the outermost, as the surface spells them: ``("data", "addNodes", 2, "pkg")``."""


class FaultCode(Enum):
    """The kind of a fault."""

    MISSING = "missing"
    """A required field or item is missing."""
    INVALID = "invalid"
    """A value that the field cannot have."""
    LIMIT = "limit"
    """Too much, or too many."""
    NOT_FOUND = "not_found"
    """It names something that does not exist."""
    CONFLICT = "conflict"
    """It contradicts what exists."""
    FORBIDDEN = "forbidden"
    """This user may not do it."""
    NO_ROOM = "no_room"
    """No machine has enough of a resource."""
    BUSY = "busy"
    """It cannot be done now, as while too much else is being done; a later attempt may succeed."""


class FieldFault(Struct, frozen=True):
    """One fault."""

    path: Path
    """Where; empty for the whole."""
    code: FaultCode
    problem: str
    """The fault, and what is valid."""

    def __str__(self) -> str:
        place = join_path(self.path)
        return f"{place}: {self.problem}" if place else self.problem

    def at(self, path: Path) -> FieldFault:
        """Return the same fault at another place."""
        return FieldFault(path, self.code, self.problem)

    def below(self, *place: str | int) -> FieldFault:
        """Return the same fault of a part of something larger."""
        return self.at((*place, *self.path))


class SpecError(ValueError):
    """User input is refused.

    Attributes:
        faults: The faults; never empty.
    """

    def __init__(self, faults: Sequence[FieldFault]) -> None:
        super().__init__("; ".join(map(str, faults)))
        self.faults = tuple(faults)


def join_path(path: Path) -> str:
    """Write a path for people: ``data.addNodes[2].pkg``."""
    text = ""
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text
