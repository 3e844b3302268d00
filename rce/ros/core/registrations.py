"""Registrations of publishers, subscribers, services and parameters. Pure.

Invariants: a node is known exactly while it holds a registration of any kind; all registrations of one node
were made with the node's one slave API URI.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum


class Kind(Enum):
    """The kind of a registration."""

    PUBLISHER = "publisher"
    SUBSCRIBER = "subscriber"
    SERVICE = "service"
    PARAMETER = "parameter"
    """A subscription to a parameter."""


@dataclass(slots=True)
class NodeEntry:
    """A known node."""

    name: str
    uri: str
    """Its slave API."""
    held: set[tuple[Kind, str]] = field(default_factory=set)
    """Everything that it has registered."""


class Registrations:
    """The tables of the master."""

    def __init__(self) -> None:
        self.nodes: dict[str, NodeEntry] = {}
        self._tables: dict[Kind, dict[str, dict[str, str]]] = {kind: {} for kind in Kind}

    def of(self, kind: Kind, name: str) -> dict[str, str]:
        """Return the nodes that registered ``name``, and the URIs they gave (a service's ``rosrpc`` URI)."""
        return self._tables[kind].get(name, {})

    def names(self, kind: Kind) -> Iterator[str]:
        """Iterate over all names registered as ``kind``."""
        return iter(self._tables[kind])

    def state(self, kind: Kind) -> list[list[object]]:
        """Return ``[[name, [node, ...]], ...]``, the form in which ``getSystemState`` answers."""
        return [[name, list(holders)] for name, holders in self._tables[kind].items()]

    def add(self, kind: Kind, name: str, node: str, uri: str, value: str | None = None) -> bool:
        """Register ``name`` for a node; return whether that changed anything.

        Args:
            kind: What is registered.
            name: Topic, service or parameter.
            node: The node's name.
            uri: The node's slave API; must be the one it is known by, if it is known.
            value: What to keep in the table in place of ``uri``.
        """
        entry = self.nodes.get(node)
        if entry is None:
            entry = self.nodes[node] = NodeEntry(node, uri)
        assert entry.uri == uri, "a node's older self must be removed first"
        entry.held.add((kind, name))
        holders = self._tables[kind].setdefault(name, {})
        is_new = node not in holders
        holders[node] = uri if value is None else value
        return is_new

    def remove(self, kind: Kind, name: str, node: str) -> bool:
        """Remove a registration; return whether it was there."""
        holders = self._tables[kind].get(name)
        if holders is None or holders.pop(node, None) is None:
            return False
        if not holders:
            del self._tables[kind][name]
        entry = self.nodes[node]
        entry.held.discard((kind, name))
        if not entry.held:
            del self.nodes[node]
        return True

    def validate(self) -> None:
        """Check the invariants; for tests."""
        held = {(kind, name, node) for node, entry in self.nodes.items() for kind, name in entry.held}
        tabled = {
            (kind, name, node)
            for kind, table in self._tables.items()
            for name, holders in table.items()
            for node in holders
        }
        assert held == tabled, "tables and nodes disagree"
        assert all(entry.held for entry in self.nodes.values()), "a node without registrations is kept"
        assert all(holders for table in self._tables.values() for holders in table.values()), (
            "an empty name is kept"
        )
