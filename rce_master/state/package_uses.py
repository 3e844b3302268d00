"""Which containers have nodes of which package."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from rce.model import split_package
from rce_master.state.records import Container

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rce.model import NodeSpec
    from rce_master.state.records import Endpoint
    from rce_master.state.table import Table

Named: TypeAlias = tuple[str, str, str]
"""A user, and the name and the version of a package as a node names it; the version may be empty."""


_NONE: Mapping[str, NodeSpec] = {}


class PackageUses:
    """Counts the nodes of containers by the package that they name.

    Args:
        endpoints: The containers.
    """

    def __init__(self, endpoints: Table[Endpoint]) -> None:
        self._counts: dict[Named, dict[str, int]] = {}
        endpoints.watch(self._endpoint_changed)

    @property
    def counts(self) -> Mapping[Named, Mapping[str, int]]:
        """The numbers of nodes, by the ids of containers."""
        return self._counts

    def containers(self, named: Named) -> Iterable[str]:
        """Return the ids of the containers with a node that names a package so."""
        return self._counts.get(named, ())

    def count(self, named: Named) -> int:
        """Return how many nodes name a package so."""
        return sum(self._counts.get(named, {}).values())

    def _endpoint_changed(self, before: Endpoint | None, after: Endpoint | None) -> None:
        was, now = _nodes(before), _nodes(after)
        if was is now:
            return
        known = before or after
        assert known is not None
        for tag, node in was.items():
            if now.get(tag) is not node:
                self._add(known.id, (known.user, *split_package(node.pkg)), -1)
        for tag, node in now.items():
            if was.get(tag) is not node:
                self._add(known.id, (known.user, *split_package(node.pkg)), 1)

    def _add(self, id_: str, named: Named, sign: int) -> None:
        counts = self._counts.setdefault(named, {})
        counts[id_] = counts.get(id_, 0) + sign
        if not counts[id_]:
            del counts[id_]
        if not counts:
            del self._counts[named]


def _nodes(endpoint: Endpoint | None) -> Mapping[str, NodeSpec]:
    return endpoint.nodes if isinstance(endpoint, Container) else _NONE
