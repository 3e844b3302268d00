"""The interfaces between a door and the robots that connect by it.

A door serves one protocol: it does the handshake (:class:`Admission` decides which robots may connect), makes
a session of each robot's stream, and keeps waiting messages in an outbox. A robot's namespace knows sessions
only as :class:`DoorSession`, so it does not depend on the door.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Coroutine, Sequence
    from contextlib import AbstractAsyncContextManager

    from rce.aio.queues import OverflowPolicy
    from rce.control import EndpointSpec
    from rce.model import EndpointId, Request
    from rce.protocol import CallId, Credentials, DataMessage, ErrorReport, LargeData
    from rce_robot.namespace import Namespace
    from rce_robot.outgoing import Rendered


class Queued(Protocol):
    """A message in an outbox."""

    @property
    def size(self) -> int:
        """Bytes for the queue's limits."""

    def render(self) -> Rendered | None:
        """Prepare it for sending; return None if that is impossible.

        Called when its turn has come: messages that are dropped in the queue are not converted.
        """


class Admission(Protocol):
    """Decides on admission and knows the robots; the task set."""

    async def log_in(self, credentials: Credentials, address: str) -> EndpointSpec:
        """Ask the master; raise :class:`HandshakeError` with its answer if the robot is refused."""

    def find(self, id: EndpointId) -> Namespace | None:  # noqa: A002
        """Return the robot's namespace if it exists."""

    async def settle(self, spec: EndpointSpec) -> Namespace:
        """Return the robot's namespace with the spec of its login applied.

        Raises:
            HandshakeError: The robot was sent away meanwhile.
        """


class DoorSession(Protocol):
    """A robot's session at a door, from the handshake until all its messages were handled."""

    @property
    def client(self) -> str:
        """The robot's address and the time of its connection, as text for its user."""

    @property
    def knows_sources(self) -> bool:
        """Whether the robot supports sources of latched messages."""

    @property
    def held(self) -> int:
        """Bytes of the robot's messages that are kept here, both ways."""

    def shed(self, size: int) -> None:
        """Drop the oldest kept messages, until ``size`` bytes are free."""

    def fail(self, reason: str) -> None:
        """Drop the connection."""

    async def close(self, reason: str, *, elsewhere: bool = False, finishes: bool = False) -> None:
        """End the connection, and tell the robot why, and if so that it can connect elsewhere.

        The requests that the robot has sent are carried out if ``finishes``, and forgotten if not.
        """

    async def probe(self) -> bool:
        """End the connection unless the robot answers; return whether it does."""

    def tick(self) -> None:
        """Do periodic work; called every few seconds."""

    def spawn(self, work: Coroutine[Any, Any, None]) -> bool:
        """Run a coroutine until the robot leaves; return False if too many run already."""

    def send_data(self, tag: str, message: Queued, overflow: OverflowPolicy, queue_size: int = 0) -> bool:
        """Send an interface's message when its turn comes; of a queue size other than 0, so many wait."""

    def send_urgent(self, message: Queued) -> bool:
        """Send a message before all data."""

    def send_latched(self, tag: str, source: str, message: Queued, *, shared: bool) -> None:
        """Send the latched message of a source; it replaces an older one that waits."""

    def send_sources(self, tag: str, sources: Sequence[str]) -> None:
        """Send which sources' latched messages are in force."""

    def drop_latched(self, tag: str, source: str) -> None:
        """Withdraw a latched message that was not sent yet."""

    def await_binaries(self, large: LargeData, ids: Sequence[str]) -> LargeData | None:
        """Return a large message with its binary values, if they have come; else handle it when they have."""

    def report(self, problem: str, call: CallId | None = None) -> None:
        """Tell the robot of an error."""

    def show_active(self, tag: str, active: bool) -> None:
        """Tell the robot whether an interface is in use."""

    def discard(self, tag: str) -> None:
        """Drop the waiting messages of a removed interface."""


class Owner(Protocol):
    """The interface of a session to its robot."""

    def take(self, message: DataMessage) -> None:
        """Handle a data message; raises :class:`RobotError` if it is refused."""

    def take_large(self, large: LargeData) -> None:
        """Handle an unparsed data message; raise :class:`RobotError` if it is refused."""

    def keep_latched(self, i_tag: str, sources: Sequence[str]) -> None:
        """The robot's sources at an interface other than these ended."""

    def refused(self, call: CallId, problem: str) -> None:
        """A message of a service call was refused before it could be handled."""

    async def ask_master(self, request: Request) -> tuple[ErrorReport, ...]:
        """Have a request carried out; return a report for each part that was refused."""

    def joined(self, session: DoorSession) -> None:
        """The session can send now."""

    def leaving(self, session: DoorSession) -> None:
        """The session's connection ended; it cannot send any more."""

    def grew(self) -> None:
        """The session holds more bytes than before. May make it :meth:`DoorSession.shed`."""

    def left(self, session: DoorSession, reason: str) -> None:
        """All received messages were handled. The session's last call."""


class Door(Protocol):
    """A door, by which robots connect."""

    def opened(self, admission: Admission) -> AbstractAsyncContextManager[None]:
        """Accept robots within the context; at its end their connections are closed."""
