"""Filters of what is synchronized: lists of patterns with the names of master_sync. Pure.

``ignore`` wins over ``sync``; an empty ``sync`` list takes everything that is not ignored. The topics and
services of a master itself (``/rosout``, the loggers' services, discovery's and sync's own) are never taken.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

from rce.ros.multimaster.errors import MultimasterError
from rce.ros.multimaster.patterns import Patterns

NEVER_NODES = (
    "/rosout",
    "/master_discovery",
    "/master_sync",
    "/node_manager",
    "/node_manager_daemon",
    "/zeroconf",
    "/param_sync",
)
NEVER_TOPICS = ("/rosout", "/rosout_agg", "/master_discovery/*", "/master_sync/*", "/zeroconf/*")
NEVER_SERVICES = (
    "/*get_loggers",
    "/*set_logger_level",
    "/master_discovery/*",
    "/master_sync/*",
    "/node_manager_daemon/*",
    "/zeroconf/*",
)
NEVER_TYPES = ("bond/Status", "fkie_multimaster_msgs/*", "multimaster_msgs_fkie/*")

_WIRE_ORDER = (
    "ignore_nodes",
    "sync_nodes",
    "ignore_topics",
    "sync_topics",
    "ignore_services",
    "sync_services",
    "ignore_type",
    "ignore_publishers",
    "ignore_subscribers",
    "do_not_sync",
)
_NONE = Patterns()

MAX_EXPRESSION = 64 * 2**10
"""Characters of one list that a peer may send."""
MAX_PATTERNS = 1000
"""Patterns of all its lists: each name of the graph is compared with them."""


@dataclass(frozen=True, slots=True)
class SyncFilter:
    """The patterns of one synchronization. Fields have the names of master_sync's parameters."""

    sync_remote_nodes: bool = False
    """Take also nodes that run on another machine than their master."""
    ignore_nodes: Patterns = _NONE
    sync_nodes: Patterns = _NONE
    ignore_topics: Patterns = _NONE
    sync_topics: Patterns = _NONE
    ignore_services: Patterns = _NONE
    sync_services: Patterns = _NONE
    ignore_type: Patterns = _NONE
    ignore_publishers: Patterns = _NONE
    ignore_subscribers: Patterns = _NONE
    do_not_sync: Patterns = _NONE

    def takes_publisher(self, node: str, topic: str, kind: str) -> bool:
        """Return whether a node's publishing of a topic is synchronized."""
        return not self.ignore_publishers.match(topic) and self._takes_topic(node, topic, kind)

    def takes_subscriber(self, node: str, topic: str, kind: str) -> bool:
        """Return whether a node's subscription to a topic is synchronized."""
        return not self.ignore_subscribers.match(topic) and self._takes_topic(node, topic, kind)

    def takes_service(self, node: str, service: str) -> bool:
        """Return whether a service is synchronized."""
        if any(self.do_not_sync.match(name) for name in (node, service)):
            return False
        if self.ignore_nodes.match(node) or self.ignore_services.match(service):
            return False
        return _wanted((self.sync_nodes, node), (self.sync_services, service))

    def _takes_topic(self, node: str, topic: str, kind: str) -> bool:
        if any(self.do_not_sync.match(name) for name in (node, topic, kind)):
            return False
        if self.ignore_type.match(kind) or self.ignore_nodes.match(node) or self.ignore_topics.match(topic):
            return False
        return _wanted((self.sync_nodes, node), (self.sync_topics, topic))

    def to_wire(self) -> list[Any]:
        """Write the filter as ``masterInfoFiltered`` takes it: a boolean and ten regular expressions."""
        patterns: list[Patterns] = [getattr(self, name) for name in _WIRE_ORDER]
        return [self.sync_remote_nodes, *(pattern.to_wire() for pattern in patterns)]

    @classmethod
    def from_wire(cls, values: Sequence[Any]) -> Self:
        """Read a filter that a peer sent; later lists may be missing.

        A list that is not understood, or is too long, lets everything pass.
        """
        read: dict[str, Patterns] = {}
        left = MAX_PATTERNS
        for name, expression in zip(_WIRE_ORDER, values[1:], strict=False):
            text = expression if isinstance(expression, str) else ""
            patterns = Patterns.from_wire(text) if len(text) <= MAX_EXPRESSION else None
            if patterns is None or len(patterns) > left:
                patterns = _everything(name)
            left -= len(patterns)
            read[name] = patterns
        return cls(bool(values[0]) if values else False, **read)


def _everything(name: str) -> Patterns:
    return Patterns(["*"]) if name.startswith("sync_") else _NONE


def _wanted(*pairs: tuple[Patterns, str]) -> bool:
    return any(patterns.match(name) for patterns, name in pairs) or not any(pattern for pattern, _ in pairs)


_NOT_HERE = ("sync_topics_on_demand",)
"""Settings of master_sync that must be off."""

NameList = list[Any]
"""Patterns; an element may be a mapping of a master's name to the patterns that hold for it alone."""


@dataclass(slots=True)
class SyncLists:
    """The lists that a user set, with master_sync's names; see :meth:`read`."""

    ignore_hosts: NameList = field(default_factory=list)
    sync_hosts: NameList = field(default_factory=list)
    ignore_nodes: NameList = field(default_factory=list)
    sync_nodes: NameList = field(default_factory=list)
    ignore_topics: NameList = field(default_factory=list)
    sync_topics: NameList = field(default_factory=list)
    ignore_services: NameList = field(default_factory=list)
    sync_services: NameList = field(default_factory=list)
    ignore_type: NameList = field(default_factory=list)
    ignore_publishers: NameList = field(default_factory=list)
    ignore_subscribers: NameList = field(default_factory=list)
    do_not_sync: NameList = field(default_factory=list)
    sync_remote_nodes: bool = False

    @classmethod
    def read(cls, values: Mapping[str, Any]) -> Self:
        """Take the values of an interface file or of a configuration.

        Raises:
            MultimasterError: A name, or the kind of a value, is unknown.
        """
        lists = cls()
        for name, value in values.items():
            if name in _NOT_HERE and not value:
                continue
            if name not in cls.__slots__:
                raise MultimasterError(f"{name} is not a setting of a synchronization")
            if name == "sync_remote_nodes":
                lists.sync_remote_nodes = bool(value)
            elif isinstance(value, str | list | dict) or value is None:
                setattr(lists, name, value if isinstance(value, list) else [] if value is None else [value])
            else:
                raise MultimasterError(f"{name} must be a list of patterns, not {value!r}")
        return lists

    def takes_host(self, master: str) -> bool:
        """Return whether a master is synchronized with."""
        ignored = Patterns(_for_master(self.ignore_hosts, ""))
        chosen = Patterns(_for_master(self.sync_hosts, ""))
        return not ignored.match(master) and (not chosen or chosen.match(master))

    def filter_for(self, master: str, *, never_nodes: Iterable[str] = ()) -> SyncFilter:
        """Make the filter that holds for one master.

        Args:
            master: The master's name.
            never_nodes: Nodes that are not synchronized besides the usual ones.
        """

        def patterns(name: str, *always: str) -> Patterns:
            return Patterns([*always, *_for_master(getattr(self, name), master)])

        return SyncFilter(
            sync_remote_nodes=self.sync_remote_nodes,
            ignore_nodes=patterns("ignore_nodes", *NEVER_NODES, *never_nodes),
            sync_nodes=patterns("sync_nodes"),
            ignore_topics=patterns("ignore_topics", *NEVER_TOPICS),
            sync_topics=patterns("sync_topics"),
            ignore_services=patterns("ignore_services", *NEVER_SERVICES),
            sync_services=patterns("sync_services"),
            ignore_type=patterns("ignore_type", *NEVER_TYPES),
            ignore_publishers=patterns("ignore_publishers"),
            ignore_subscribers=patterns("ignore_subscribers"),
            do_not_sync=patterns("do_not_sync"),
        )


def _for_master(entries: Iterable[Any], master: str) -> list[str]:
    found: list[str] = []
    for entry in entries:
        if isinstance(entry, Mapping):
            values = entry.get(master, [])
            found += [str(value) for value in (values if isinstance(values, list) else [values])]
        else:
            found.append(str(entry))
    return found
