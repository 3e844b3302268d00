"""Reports to managers about a container: the whole status first, then patches if they accept them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.control import NODE_STATES, PATCHES, EndpointStatus, StatusPatch
from rce.control.execution import FEATURE as EXEC
from rce_container.environment import messages as m

if TYPE_CHECKING:
    from collections.abc import Collection

    from rce.link import Endpoint
    from rce_container.environment.channel import Channel

FEATURES = (EXEC, PATCHES, NODE_STATES)
"""The features of this environment that earlier releases do not have."""


class Reporter:
    """Sends each manager only changes.

    Args:
        endpoint: Has the container's interfaces and connections.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self._told: EndpointStatus | None = None
        """The last report to the manager; without interfaces and connections, if it takes patches."""
        self._takes_patches = False

    def begin(self) -> None:
        """Start over for a new manager, whose features are not known yet."""
        self._told = None
        self._takes_patches = False

    def learn(self, features: Collection[str]) -> None:
        """Note the manager's features."""
        self._takes_patches = PATCHES in features

    def report(self, channel: Channel, header: EndpointStatus) -> None:
        """Send the manager the changes since its last report.

        Args:
            channel: Connects to the manager.
            header: The container's status without interfaces and connections.
        """
        if self._told is not None and self._takes_patches:
            self._report_changes(channel, header)
            return
        self._endpoint.take_news()
        interfaces = dict(self._endpoint.interfaces)
        status = replace(header, interfaces=interfaces, connections=self._endpoint.connections)
        if status != self._told:
            self._told = status
            channel.send(m.encode(m.Report(status=status, features=FEATURES)))

    def _report_changes(self, channel: Channel, header: EndpointStatus) -> None:
        news = self._endpoint.take_news()
        if header == self._told and not news:
            return
        self._told = header
        patch = StatusPatch(
            status=replace(header, interfaces=news.interfaces, connections=tuple(news.connections)),
            removed_interfaces=tuple(news.removed_interfaces),
            lost_connections=tuple(news.lost_connections),
        )
        channel.send(m.encode(m.ReportPatch(patch=patch)))
