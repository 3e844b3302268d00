"""The topics and services of a discovery in its own graph, with the names of master_discovery."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rce.ros.multimaster import messages
from rce.ros.multimaster.peer_table import Link, Neighbour, PeerEvent
from rce.ros.node import Node, Publisher
from rce.ros.types.values import Time

NAME_PARAMETER = "/mastername"
"""Set by master_discovery too."""

URI_PARAMETER = "~masteruri"
"""The master's URI for other machines."""


LAST_HEARTBEAT = "last_heartbeat"
"""A time; a field of ``LinkState`` since release 1.1.0 of fkie's messages."""


class Announcements:
    """The topics and services of a discovery node."""

    def __init__(self, changes: Publisher, link_stats: Publisher) -> None:
        self._changes = changes
        self._link_stats = link_stats
        (links,) = (field.message for field in link_stats.type.fields if field.name == "links")
        self._tells_heartbeats = links is not None and any(
            (field.name, field.type) == (LAST_HEARTBEAT, "time") for field in links.fields
        )

    @classmethod
    async def open(
        cls,
        node: Node,
        masters: Callable[[], Iterable[Neighbour]],
        refresh: Callable[[], None],
        *,
        name: str,
        uri: str,
    ) -> Announcements:
        """Advertise everything.

        Args:
            node: The discovery node.
            masters: Tells the known masters.
            refresh: Asks all masters for their state.
            name: The local master's name.
            uri: The local master's URI as others are told.

        Raises:
            MasterError: The registration at the master failed.
        """
        await cls.set_parameters(node, name, uri)  # before a synchronization finds the rest
        changes = await node.advertise("~changes", messages.MASTER_STATE)
        link_stats = await node.advertise("~linkstats", messages.LINK_STATES)

        def list_masters(_request: Any) -> dict[str, Any]:
            return {"masters": [messages.ros_master(master) for master in masters()]}

        def refresh_all(_request: Any) -> None:
            refresh()

        await node.advertise_service("~list_masters", messages.DISCOVER_MASTERS, list_masters)
        await node.advertise_service("~refresh", messages.EMPTY, refresh_all)
        return cls(changes, link_stats)

    @staticmethod
    async def set_parameters(node: Node, name: str, uri: str) -> None:
        """Set the parameters with the master's name and URI."""
        await node.set_param(NAME_PARAMETER, name)
        await node.set_param(URI_PARAMETER, uri)

    def tell(self, event: PeerEvent) -> None:
        """Publish a change."""
        self._changes.publish(messages.master_state(event))

    def tell_links(self, name: str, links: Iterable[Link], now: float) -> None:
        """Publish the quality of all links, seen from the master ``name`` at ``now`` (seconds since 1970)."""
        if self._link_stats.connections == 0:
            return
        self._link_stats.publish(
            header={"stamp": _time(now), "frame_id": name},
            links=[self._link_state(link, now) for link in links],
        )

    def _link_state(self, link: Link, now: float) -> dict[str, Any]:
        state: dict[str, Any] = {"destination": link.name, "quality": link.quality}
        return state | ({LAST_HEARTBEAT: _time(now - link.silence)} if self._tells_heartbeats else {})


def _time(seconds: float) -> Time:
    secs, fraction = divmod(max(0.0, seconds), 1)
    return Time(int(secs), int(fraction * 1e9))
