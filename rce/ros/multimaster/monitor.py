"""Turns a master's registrations into the state that others are told, and notes when it changed."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field, replace

from rce.ros.multimaster.heartbeat import Stamp
from rce.ros.multimaster.source import MasterSource, Snapshot
from rce.ros.multimaster.state import MasterInfo, Provider, host_of


@dataclass(frozen=True, slots=True)
class Origins:
    """What a synchronization registered, by ``(name, URI)``: the master that it came from."""

    nodes: Mapping[tuple[str, str], str] = field(default_factory=dict)
    services: Mapping[tuple[str, str], str] = field(default_factory=dict)
    is_complete: bool = True
    """Whether every synchronization answered."""


AskOrigins = Callable[[Snapshot], Awaitable[Origins]]
"""Asks the synchronizations of this master, found by their services."""


class MasterMonitor:
    """The state of one master.

    Attributes:
        info: The state; None until it was read.
        restarts: How often another process was found in the master's place.
    """

    def __init__(
        self, uri: str, name: str, source: MasterSource, hosts: Callable[[], frozenset[str]], ask: AskOrigins
    ) -> None:
        """Watch a master.

        Args:
            uri: Its URI as others are told.
            name: Its name.
            source: Reads the registrations.
            hosts: Tells all names and addresses of the master's machine.
            ask: Returns the registrations that synchronizations made.
        """
        self.info: MasterInfo | None = None
        self.restarts = 0
        self._uri = uri
        self._name = name
        self._source = source
        self._hosts = hosts
        self._ask = ask
        self._last: Snapshot | None = None
        self._knows_origins = False

    async def poll(self, now: float) -> bool:
        """Read the master; return whether it changed.

        Args:
            now: The time of day, in seconds.

        Raises:
            MasterError: It does not answer.
        """
        snapshot = await self._source.read()
        if snapshot == self._last and self._knows_origins:
            return False
        if self._last is not None and self._last.run != snapshot.run:
            self.restarts += 1
        origins = await self._ask(snapshot)
        new = describe(snapshot, self._uri, self._name, self._hosts(), origins)
        is_known = snapshot == self._last and self.info is not None and new.same_graph(self.info)
        self._last, self._knows_origins = snapshot, origins.is_complete
        if not is_known:
            self._take(new, now)
        return not is_known

    def _take(self, new: MasterInfo, now: float) -> None:
        old = self.info
        stamp = Stamp.from_seconds(now)
        same_own = old is not None and old.own_part() == new.own_part()
        stamp_local = old.stamp_local if same_own and old is not None else stamp
        self.info = replace(new, stamp=stamp, stamp_local=stamp_local)


def describe(snapshot: Snapshot, uri: str, name: str, hosts: frozenset[str], origins: Origins) -> MasterInfo:
    """Return the state: each registration with its origin and whether it is on this machine."""

    def provider(of: Mapping[tuple[str, str], str], key: str, at: str) -> Provider:
        origin = of.get((key, at), uri)
        return Provider(at, origin, origin == uri and host_of(at) in hosts)

    return MasterInfo(
        uri=uri,
        name=name,
        publishers=snapshot.publishers,
        subscribers=snapshot.subscribers,
        services=snapshot.services,
        topic_types=snapshot.topic_types,
        nodes={key: provider(origins.nodes, key, at) for key, at in snapshot.node_uris.items()},
        service_uris={key: provider(origins.services, key, at) for key, at in snapshot.service_uris.items()},
    )
