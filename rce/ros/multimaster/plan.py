"""Plan what a synchronization registers at the local master, and what it must leave out. Pure.

A remote node is registered under its own name and URI, so nodes connect to each other directly. A master
takes a second node of the same name for a restart of the first one, and tells the first to shut down. So a
node whose name is taken here by another is left out and reported.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum

from rce.ros.multimaster.filters import SyncFilter
from rce.ros.multimaster.state import MasterInfo, Names, Provider, host_of
from rce.ros.node.settings import is_loopback

ANY_TYPE = "*"


class RegistrationKind(Enum):
    """The kind of a registration."""

    SUBSCRIBER = "subscriber"
    PUBLISHER = "publisher"
    SERVICE = "service"


@dataclass(frozen=True, slots=True)
class Registration:
    """One entry at a master."""

    kind: RegistrationKind
    name: str
    """The topic or service."""
    node: str
    uri: str
    """The node's API."""
    detail: str
    """A topic's type, or a service's address."""


@dataclass(frozen=True, slots=True)
class Clash:
    """A remote entry that cannot be registered, because the local graph has one of that name."""

    registration: Registration
    taken_by: str
    """The URI that has the name here."""

    def __str__(self) -> str:
        what = self.registration
        if what.kind is RegistrationKind.SERVICE:
            return f"service {what.name} of {what.node} is left out: it is provided here by {self.taken_by}"
        return (
            f"node {what.node} ({what.uri}) is left out: a node of that name is here already"
            f" ({self.taken_by}); registering both would shut one down. Rename one, or use --distinct-names"
        )


def wanted(
    remote: MasterInfo, own_uri: str, chosen: SyncFilter, *, distinct_names: bool = False
) -> set[Registration]:
    """Return the registrations to make for a remote master.

    Args:
        remote: The master's state.
        own_uri: The local master; registrations that came from it are left out.
        chosen: The user's filter.
        distinct_names: Register nodes as ``NODE_at_MASTER``, so that equal names do not clash.
    """
    found = set(_Reader(remote, own_uri, chosen).registrations())
    return {_renamed(entry, remote.name) for entry in found} if distinct_names else found


class _Reader:
    """Reads a remote master's state as registrations."""

    def __init__(self, remote: MasterInfo, own_uri: str, chosen: SyncFilter) -> None:
        self._remote = remote
        self._own_uri = own_uri
        self._with_remote_nodes = chosen.sync_remote_nodes
        self._part = remote.filtered(chosen)

    def registrations(self) -> Iterator[Registration]:
        part = self._part
        yield from self._topics(RegistrationKind.PUBLISHER, part.publishers, "")
        yield from self._topics(RegistrationKind.SUBSCRIBER, part.subscribers, ANY_TYPE)
        for service, node in _pairs(part.services):
            address, uri = self._uri(part.service_uris.get(service)), self._uri(part.nodes.get(node))
            if address and uri:
                yield Registration(RegistrationKind.SERVICE, service, node, uri, address)

    def _topics(self, kind: RegistrationKind, names: Names, unknown: str) -> Iterator[Registration]:
        for topic, node in _pairs(names):
            topic_type = self._part.topic_types.get(topic, unknown)
            uri = self._uri(self._part.nodes.get(node))
            if topic_type and uri:
                yield Registration(kind, topic, node, uri, topic_type)

    def _uri(self, provider: Provider | None) -> str:
        if (
            provider is None
            or provider.master_uri == self._own_uri
            or _is_unreachable(provider, self._remote)
        ):
            return ""
        if provider.is_local or (self._with_remote_nodes and provider.master_uri == self._remote.uri):
            return provider.uri
        return ""


def unreachable_nodes(remote: MasterInfo) -> list[str]:
    """Return the nodes that registered a loopback address, under which other machines cannot reach them."""
    return sorted(name for name, node in remote.nodes.items() if _is_unreachable(node, remote))


def split_clashes(
    candidates: Iterable[Registration],
    nodes: Mapping[str, str],
    services: Mapping[str, str],
) -> tuple[set[Registration], list[Clash]]:
    """Split candidates into those that can be registered and those that would displace an entry.

    A node or service that is registered here with the same URI is not a clash, and is not registered again:
    it is the same one, registered by itself or by another synchronization.

    Args:
        candidates: The registrations to make.
        nodes: Nodes of the local graph that this synchronization did not register, and their URIs.
        services: Services of the local graph that it did not register, and their addresses.
    """
    fine: set[Registration] = set()
    clashes: list[Clash] = []
    for entry in candidates:
        taken = nodes.get(entry.node, "")
        if not taken and entry.kind is RegistrationKind.SERVICE:
            taken = services.get(entry.name, "")
            if taken == entry.detail:
                continue
        if not taken:
            fine.add(entry)
        elif taken != entry.uri:
            clashes.append(Clash(entry, taken))
    return fine, clashes


def _pairs(names: Names) -> Iterator[tuple[str, str]]:
    return ((name, node) for name, nodes in names.items() for node in nodes)


def _is_unreachable(provider: Provider, remote: MasterInfo) -> bool:
    return is_loopback(host_of(provider.uri)) and not is_loopback(host_of(remote.uri))


def _renamed(entry: Registration, master: str) -> Registration:
    suffix = "".join(letter if letter.isalnum() else "_" for letter in master)
    return Registration(entry.kind, entry.name, f"{entry.node}_at_{suffix}", entry.uri, entry.detail)
