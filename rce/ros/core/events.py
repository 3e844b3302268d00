"""The results of a change of the graph: calls to make, and events for watchers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any


@dataclass(frozen=True, slots=True)
class Call:
    """A call that the core must make to a node because of another node's change."""

    uri: str
    """The node's slave API."""
    method: str
    """``publisherUpdate``, ``paramUpdate`` or ``shutdown``."""
    arguments: tuple[Any, ...]
    """The arguments after the core's own name."""

    @property
    def key(self) -> tuple[str, Any]:
        """Calls of one key replace each other: they carry the whole state of one topic or parameter."""
        return self.method, self.arguments[0] if self.arguments else None


class Change(Enum):
    """The kind of a change of the graph."""

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
    """The calls and events that follow from one operation on the graph."""

    calls: list[Call]
    events: list[GraphEvent]

    @classmethod
    def empty(cls) -> Outcome:
        """Make an outcome to be filled."""
        return cls([], [])
