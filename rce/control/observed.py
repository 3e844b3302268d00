"""The observed status of one endpoint, kept part by part: a change costs only what it changes. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

if TYPE_CHECKING:
    from rce.control.model import EndpointStatus, StatusPatch


class ObservedStatus:
    """The status of one endpoint.

    Args:
        status: The first report.
        max_parts: How many interfaces, and how many connections, are kept at most; others are left out.

    Attributes:
        header: What was reported last, without interfaces and connections.
    """

    def __init__(self, status: EndpointStatus, max_parts: int | None = None) -> None:
        self._max_parts = max_parts
        self.replace(status)

    @property
    def whole(self) -> EndpointStatus:
        """The whole status."""
        return replace(
            self.header, interfaces=dict(self._interfaces), connections=tuple(sorted(self._connections))
        )

    def replace(self, status: EndpointStatus) -> None:
        """Take over a whole report."""
        self.header = without_wiring(status)
        self._interfaces: dict[str, bool] = {}
        self._connections: set[int] = set()
        self._put(status)

    def patch(self, patch: StatusPatch) -> None:
        """Take over a patch of a report."""
        self.header = without_wiring(patch.status)
        for tag in patch.removed_interfaces:
            self._interfaces.pop(tag, None)
        self._connections.difference_update(patch.lost_connections)
        self._put(patch.status)

    def _put(self, status: EndpointStatus) -> None:
        for tag, is_active in status.interfaces.items():
            if tag in self._interfaces or self._has_room(len(self._interfaces)):
                self._interfaces[tag] = is_active
        for number in status.connections:
            if self._has_room(len(self._connections)):
                self._connections.add(number)

    def _has_room(self, count: int) -> bool:
        return self._max_parts is None or count < self._max_parts


def without_wiring(status: EndpointStatus) -> EndpointStatus:
    """Return a status without interfaces and connections."""
    return replace(status, interfaces={}, connections=())
