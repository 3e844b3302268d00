"""A master's state as discoveries exchange it (``masterInfo``). Pure.

On the wire it is a list of ten: ``stamp, stamp_local`` (seconds, as text with nine decimals), ``masteruri,
name, publishers, subscribers, services`` (``[[name, [node, ...]], ...]`` each), ``topicTypes``
(``[[topic, type], ...]``), ``nodeProviders`` (``[[node, uri, masteruri, pid, "local" | "remote"], ...]``) and
``serviceProviders`` (``[[service, uri, masteruri, type, "local" | "remote"], ...]``). ``masteruri`` of a node
is that of the master it registered at itself; ``remote`` means that it runs on another machine than that
master.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any
from urllib.parse import urlsplit

from rce.ros.multimaster.errors import MalformedStateError
from rce.ros.multimaster.filters import SyncFilter
from rce.ros.multimaster.heartbeat import ZERO, Stamp

LOCAL, REMOTE = "local", "remote"
_NO_TYPES = ("", "None")

Names = Mapping[str, tuple[str, ...]]
"""Topic or service -> its nodes."""


@dataclass(frozen=True, slots=True)
class Provider:
    """A node's API or a service's address."""

    uri: str
    master_uri: str
    """The master where it registered itself."""
    is_local: bool
    """Whether it runs on that master's machine."""


@dataclass(frozen=True, slots=True)
class MasterInfo:
    """Everything that is registered at one master."""

    uri: str
    name: str
    stamp: Stamp = ZERO
    stamp_local: Stamp = ZERO
    publishers: Names = field(default_factory=dict)
    subscribers: Names = field(default_factory=dict)
    services: Names = field(default_factory=dict)
    topic_types: Mapping[str, str] = field(default_factory=dict)
    nodes: Mapping[str, Provider] = field(default_factory=dict)
    service_uris: Mapping[str, Provider] = field(default_factory=dict)

    def same_graph(self, other: MasterInfo) -> bool:
        """Return whether the two differ in their stamps only."""
        return replace(other, stamp=self.stamp, stamp_local=self.stamp_local) == self

    def own_part(self) -> MasterInfo:
        """Return the registrations that nodes made here themselves, not a synchronization."""
        own_nodes = {name: node for name, node in self.nodes.items() if node.master_uri == self.uri}
        own_services = {
            name: service for name, service in self.service_uris.items() if service.master_uri == self.uri
        }

        def own(names: Names) -> Names:
            kept = {name: tuple(node for node in nodes if node in own_nodes) for name, nodes in names.items()}
            return {name: nodes for name, nodes in kept.items() if nodes}

        return replace(
            self,
            stamp=ZERO,
            stamp_local=ZERO,
            publishers=own(self.publishers),
            subscribers=own(self.subscribers),
            services={name: nodes for name, nodes in self.services.items() if name in own_services},
            topic_types={},
            nodes=own_nodes,
            service_uris=own_services,
        )

    def filtered(self, chosen: SyncFilter) -> MasterInfo:
        """Return the part that passes a filter."""

        def kind(topic: str) -> str:
            return self.topic_types.get(topic, "")

        publishers = _choose(
            self.publishers, lambda node, name: chosen.takes_publisher(node, name, kind(name))
        )
        subscribers = _choose(
            self.subscribers, lambda node, name: chosen.takes_subscriber(node, name, kind(name))
        )
        services = _choose(self.services, chosen.takes_service)
        used = {
            node
            for names in (publishers, subscribers, services)
            for nodes in names.values()
            for node in nodes
        }
        return replace(
            self,
            publishers=publishers,
            subscribers=subscribers,
            services=services,
            topic_types={
                topic: text
                for topic, text in self.topic_types.items()
                if topic in publishers or topic in subscribers
            },
            nodes={name: node for name, node in self.nodes.items() if name in used},
            service_uris={name: uri for name, uri in self.service_uris.items() if name in services},
        )

    def to_wire(self) -> list[Any]:
        """Write the ten values."""
        return [
            stamp_text(self.stamp),
            stamp_text(self.stamp_local),
            self.uri,
            self.name,
            *([[name, list(nodes)] for name, nodes in names.items()] for names in self._names()),
            [list(pair) for pair in self.topic_types.items()],
            [[name, node.uri, node.master_uri, 0, _place(node)] for name, node in self.nodes.items()],
            [
                [name, service.uri, service.master_uri, "", _place(service)]
                for name, service in self.service_uris.items()
            ],
        ]

    def _names(self) -> tuple[Names, Names, Names]:
        return self.publishers, self.subscribers, self.services

    @classmethod
    def from_wire(cls, values: Any) -> MasterInfo:
        """Read the ten values.

        Raises:
            MalformedStateError: The values do not have this form.
        """
        try:
            stamp, local, uri, name, publishers, subscribers, services, types, nodes, providers = values
            return cls(
                _text(uri),
                _text(name),
                Stamp.from_seconds(float(stamp)),
                Stamp.from_seconds(float(local)),
                read_names(publishers),
                read_names(subscribers),
                read_names(services),
                {_text(topic): _text(kind) for topic, kind in types if kind and kind not in _NO_TYPES},
                _providers(nodes),
                _providers(providers),
            )
        except (TypeError, ValueError, OverflowError) as error:
            raise MalformedStateError(f"this is not a masterInfo: {error}") from error


def stamp_text(stamp: Stamp) -> str:
    """Write a stamp as the RPC methods do: seconds with nine decimals."""
    return f"{stamp.secs}.{stamp.nsecs:09d}"


def read_names(entries: Any) -> dict[str, tuple[str, ...]]:
    """Read ``[[name, [node, ...]], ...]``.

    Raises:
        TypeError: A name is not a text, or this is not a list.
        ValueError: An entry is not a pair.
    """
    return {_text(name): tuple(_text(node) for node in nodes) for name, nodes in entries}


def host_of(uri: str) -> str:
    """Return the host in a URI; empty if there is none."""
    try:
        return urlsplit(uri).hostname or ""
    except ValueError:
        return ""


def _choose(names: Names, takes: Any) -> Names:
    kept = {name: tuple(node for node in nodes if takes(node, name)) for name, nodes in names.items()}
    return {name: nodes for name, nodes in kept.items() if nodes}


def _place(provider: Provider) -> str:
    return LOCAL if provider.is_local else REMOTE


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"expected a text, found {type(value).__name__}")
    return value


def _providers(entries: Any) -> dict[str, Provider]:
    """Read providers; one whose address its discovery does not know (yet) is left out."""
    return {
        _text(name): Provider(_text(uri), _text(master_uri), place == LOCAL)
        for name, uri, master_uri, _, place in entries
        if uri
    }
