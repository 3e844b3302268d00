"""Reports to the master about a robot: the whole status first, then patches if it accepts them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.control import EndpointState, EndpointStatus, LinkAddress, StatusPatch

if TYPE_CHECKING:
    from rce.link import Endpoint
    from rce_robot.doors.base import DoorSession


class RobotReporter:
    """Makes the reports of one robot, and numbers them.

    Args:
        endpoint: The robot's endpoint.
        address: Where links to it are accepted.
    """

    def __init__(self, endpoint: Endpoint, address: LinkAddress) -> None:
        self._endpoint = endpoint
        self._address = address
        self._number = 0
        """Of the last report."""
        self._session: DoorSession | None = None
        """The session at that time."""

    def whole(self, revision: int, session: DoorSession | None) -> EndpointStatus:
        """Return the whole status.

        Args:
            revision: The newest spec that was applied.
            session: The robot's session; None while it is away.
        """
        return replace(
            self._header(revision, session),
            interfaces=dict(self._endpoint.interfaces),
            connections=tuple(self._endpoint.connections),
        )

    def next(
        self, revision: int, session: DoorSession | None, *, in_patches: bool
    ) -> EndpointStatus | StatusPatch:
        """Return the next report for the master.

        Args:
            revision: The newest spec that was applied.
            session: The robot's session; None while it is away.
            in_patches: Whether the master takes patches. It still gets the whole status when the robot
                connected or left, because it then forgets the former one.
        """
        self._number += 1
        news = self._endpoint.take_news()
        if not in_patches or self._number == 1 or self._session is not session:
            self._session = session
            return self.whole(revision, session)
        header = self._header(revision, session)
        return StatusPatch(
            status=replace(header, interfaces=news.interfaces, connections=tuple(news.connections)),
            removed_interfaces=tuple(news.removed_interfaces),
            lost_connections=tuple(news.lost_connections),
        )

    def _header(self, revision: int, session: DoorSession | None) -> EndpointStatus:
        """Return a status without interfaces and connections."""
        return EndpointStatus(
            id=str(self._endpoint.id),
            revision=revision,
            state=EndpointState.RUNNING if session is not None else EndpointState.ABSENT,
            address=self._address,
            client=session.client if session is not None else "",
            number=self._number,
        )
