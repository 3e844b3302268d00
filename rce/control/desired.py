"""The desired state of one endpoint, kept part by part: a change costs only what it changes. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, TypeVar

from rce.control.model import (
    ConnectionSpec,
    EndpointContents,
    EndpointKind,
    EndpointSpec,
    LinkSpec,
    SpecPatch,
)

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping

    from rce.model import InterfaceSpec

K = TypeVar("K", bound="Hashable")
V = TypeVar("V")


@dataclass(slots=True)
class Difference:
    """Which parts of a spec changed, in order: what they are now, or that they are gone, the spec tells."""

    interfaces: dict[str, None] = field(default_factory=dict)
    """By tag."""
    links: dict[str, None] = field(default_factory=dict)
    """By id."""
    connections: dict[int, None] = field(default_factory=dict)
    """By id."""
    contents: bool = False

    def include(self, later: Difference) -> None:
        """Include what changed after this."""
        self.interfaces.update(later.interfaces)
        self.links.update(later.links)
        self.connections.update(later.connections)
        self.contents |= later.contents


class Fit(Enum):
    """How a patch relates to the present state."""

    OLD = "old"
    """It is already applied."""
    NEXT = "next"
    """It can be applied."""
    GAP = "gap"
    """Patches before it are missing: the whole spec is needed."""


class DesiredState:
    """The desired state of one endpoint.

    Invariant: whole specs and patches that lead to the same revision lead to the same :attr:`whole`, up to
    the order of its parts.

    Args:
        spec: What is desired at first.

    Attributes:
        id: Endpoint id.
        kind: What the endpoint is.
        revision: Of the newest spec or patch.
        interfaces: By tag.
        links: By id.
        connections: By id.
        contents: Everything else.
    """

    def __init__(self, spec: EndpointSpec) -> None:
        self.id = spec.id
        self.kind: EndpointKind = spec.kind
        self.revision = spec.revision
        self.interfaces: dict[str, InterfaceSpec] = {}
        self.links: dict[str, LinkSpec] = {}
        self.connections: dict[int, ConnectionSpec] = {}
        self.contents = _contents(spec)
        self._ends: dict[int, tuple[str, ...]] = {}
        """The tags of each connection's interfaces at this endpoint."""
        self._at: dict[str, dict[int, None]] = {}
        self._on: dict[str, dict[int, None]] = {}
        self.replace(spec)

    @property
    def whole(self) -> EndpointSpec:
        """The whole desired state."""
        contents = self.contents
        return EndpointSpec(
            id=self.id,
            kind=self.kind,
            revision=self.revision,
            interfaces=tuple(self.interfaces.values()),
            links=tuple(self.links.values()),
            connections=tuple(self.connections.values()),
            resources=contents.resources,
            nodes=contents.nodes,
            parameters=contents.parameters,
            packages=contents.packages,
            volumes=contents.volumes,
        )

    def connections_at(self, interface: str) -> tuple[int, ...]:
        """Return the ids of the connections of an interface of this endpoint."""
        return tuple(self._at.get(interface, ()))

    def connections_on(self, link: str) -> tuple[int, ...]:
        """Return the ids of the connections on a link."""
        return tuple(self._on.get(link, ()))

    def fit(self, patch: SpecPatch) -> Fit:
        """Return how a patch relates to what is desired."""
        if patch.revision <= self.revision:
            return Fit.OLD
        return Fit.NEXT if patch.base == self.revision else Fit.GAP

    def replace(self, spec: EndpointSpec) -> Difference:
        """Take over a whole spec; return what it changes."""
        contents = _contents(spec)
        difference = Difference(
            interfaces=_differing(self.interfaces, {one.tag: one for one in spec.interfaces}),
            links=_differing(self.links, {one.id: one for one in spec.links}),
            connections=_differing(self.connections, {one.id: one for one in spec.connections}),
            contents=contents != self.contents,
        )
        self.revision = spec.revision
        self.contents = contents
        self.interfaces = {one.tag: one for one in spec.interfaces}
        self.links = {one.id: one for one in spec.links}
        self.connections, self._ends, self._at, self._on = {}, {}, {}, {}
        for connection in spec.connections:
            self._put(connection)
        return difference

    def patch(self, patch: SpecPatch) -> Difference:
        """Take over a patch that fits; return what it changes."""
        for number in patch.removed_connections:
            self._remove(number)
        for tag in patch.removed_interfaces:
            self.interfaces.pop(tag, None)
        for link_id in patch.removed_links:
            self.links.pop(link_id, None)
        self.interfaces.update({one.tag: one for one in patch.interfaces})
        self.links.update({one.id: one for one in patch.links})
        for connection in patch.connections:
            self._remove(connection.id)
            self._put(connection)
        self.contents = self.contents if patch.contents is None else patch.contents
        self.revision = patch.revision
        return Difference(
            interfaces=dict.fromkeys((*patch.removed_interfaces, *(one.tag for one in patch.interfaces))),
            links=dict.fromkeys((*patch.removed_links, *(one.id for one in patch.links))),
            connections=dict.fromkeys((*patch.removed_connections, *(one.id for one in patch.connections))),
            contents=patch.contents is not None,
        )

    def _put(self, connection: ConnectionSpec) -> None:
        self.connections[connection.id] = connection
        link = self.links.get(connection.link)
        is_here = link is not None and link.peer == self.id
        ends = (connection.interface, *((connection.peer_interface,) if is_here else ()))
        self._ends[connection.id] = ends
        for tag in ends:
            self._at.setdefault(tag, {})[connection.id] = None
        self._on.setdefault(connection.link, {})[connection.id] = None

    def _remove(self, number: int) -> None:
        connection = self.connections.pop(number, None)
        if connection is None:
            return
        for tag in self._ends.pop(number):
            _discard(self._at, tag, number)
        _discard(self._on, connection.link, number)


def _contents(spec: EndpointSpec) -> EndpointContents:
    return EndpointContents(
        resources=spec.resources,
        nodes=spec.nodes,
        parameters=spec.parameters,
        packages=spec.packages,
        volumes=spec.volumes,
    )


def _differing(before: Mapping[K, V], after: Mapping[K, V]) -> dict[K, None]:
    changed = [key for key, value in after.items() if before.get(key) != value]
    return dict.fromkeys((*(key for key in before if key not in after), *changed))


def _discard(index: dict[str, dict[int, None]], key: str, number: int) -> None:
    found = index.get(key)
    if found is not None:
        found.pop(number, None)
        if not found:
            del index[key]
