"""What comes out of the graph's state when something changed: calls to make and events to watch."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any


@dataclass(frozen=True, slots=True)
class Call:
    """A call that the core owes a node, because of something that another node did."""

    uri: str
    """The node's slave API."""
    method: str
    """``publisherUpdate``, ``paramUpdate`` or ``shutdown``."""
    arguments: tuple[Any, ...]
    """What follows the core's own name."""

    @property
    def key(self) -> tuple[str, Any]:
        """Calls of one key replace each other: they carry the whole state of one topic or parameter."""
        return self.method, self.arguments[0] if self.arguments else None


class Change(Enum):
    """What happened in the graph."""

    NODE_APPEARED = "node appeared"
    NODE_VANISHED = "node vanished"
    PUBLISHER_ADDED = "publisher added"
    PUBLISHER_REMOVED = "publisher removed"
    SUBSCRIBER_ADDED = "subscriber added"
    SUBSCRIBER_REMOVED = "subscriber removed"
    SERVICE_ADDED = "service added"
    SERVICE_REMOVED = "service removed"


@dataclass(frozen=True, slots=True)
class GraphEvent:
    """One change of the graph."""

    change: Change
    node: str
    """Name of the node that appeared, vanished, or whose topic or service this is."""
    name: str = ""
    """The topic or service; empty for the events of nodes."""


@dataclass(slots=True)
class Outcome:
    """All that follows from one operation on the graph."""

    calls: list[Call]
    events: list[GraphEvent]

    @classmethod
    def empty(cls) -> Outcome:
        """Make an outcome to be filled."""
        return cls([], [])
