"""What a door owes the robots behind it, and what it may ask of them.

A door serves one protocol: it shakes hands (:class:`Admission` says who may come in), makes a session of each
robot's stream, and keeps what waits for the robot in an outbox. A robot's namespace knows sessions only as
:class:`DoorSession`, so it is the same by whichever door its robot came.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Coroutine, Sequence
    from contextlib import AbstractAsyncContextManager

    from rce.aio.queues import OverflowPolicy
    from rce.control.model import EndpointSpec
    from rce.model.names import EndpointId
    from rce.model.requests import Request
    from rce.protocol.http import Credentials
    from rce.protocol.messages import CallId, DataMessage
    from rce.protocol.stream import LargeData
    from rce_robot.namespace import Namespace
    from rce_robot.outgoing import Rendered


class Queued(Protocol):
    """What an outbox holds."""

    @property
    def size(self) -> int:
        """Bytes that it counts in the queue's limits."""

    def render(self) -> Rendered | None:
        """Make it ready to be sent; None if that turns out to be impossible.

        Called when its turn has come: a message that is dropped in the queue costs no conversion.
        """


class Admission(Protocol):
    """Who lives here, and who knows who may; the task set."""

    async def log_in(self, credentials: Credentials, address: str) -> EndpointSpec:
        """Ask the master; raises :class:`HandshakeError` with its answer if the robot may not come in."""

    def find(self, id: EndpointId) -> Namespace | None:  # noqa: A002
        """Return the robot's namespace if there is one."""

    async def settle(self, spec: EndpointSpec) -> Namespace:
        """Return the robot's namespace with the spec applied."""


class DoorSession(Protocol):
    """A robot that came in by a door, from the handshake until everything that it sent was handled."""

    @property
    def client(self) -> str:
        """From where the robot is connected, and since when, in words for its user."""

    @property
    def knows_sources(self) -> bool:
        """Whether the robot can be told of the sources of latched messages."""

    @property
    def held(self) -> int:
        """Bytes of the robot's messages that are kept here, both ways."""

    def shed(self, size: int) -> None:
        """Drop the oldest of what is kept, until ``size`` bytes are free."""

    def fail(self, reason: str) -> None:
        """Drop the connection."""

    async def close(self, reason: str) -> None:
        """End the connection, and tell the robot why."""

    async def probe(self) -> bool:
        """End the connection unless the robot answers; return whether it does."""

    def tick(self) -> None:
        """Do what is to be done every few seconds."""

    def spawn(self, work: Coroutine[Any, Any, None]) -> bool:
        """Run something until the robot leaves; False if there is too much of it."""

    def send_data(self, tag: str, message: Queued, overflow: OverflowPolicy) -> bool:
        """Send an interface's message when its turn comes."""

    def send_urgent(self, message: Queued) -> bool:
        """Send a message before all data."""

    def send_latched(self, tag: str, source: str, message: Queued, *, shared: bool) -> None:
        """Send the latched message of a source; it takes the place of an older one that waits."""

    def send_sources(self, tag: str, sources: Sequence[str]) -> None:
        """Tell which sources' latched messages are in force."""

    def drop_latched(self, tag: str, source: str) -> None:
        """Take a latched message back, if it was not sent yet."""

    def await_binaries(self, large: LargeData, ids: Sequence[str]) -> None:
        """Have a large message come again with its binary values."""

    def report(self, problem: str, call: CallId | None = None) -> None:
        """Tell the robot of an error."""

    def show_active(self, tag: str, active: bool) -> None:
        """Tell the robot whether an interface is in use."""

    def discard(self, tag: str) -> None:
        """Drop what waits of an interface that is gone."""


class Owner(Protocol):
    """What a session needs of the robot it belongs to."""

    def take(self, message: DataMessage) -> None:
        """Handle a data message; raises :class:`RobotError` if it is refused."""

    def take_large(self, large: LargeData) -> None:
        """Handle a data message that was not parsed yet; raises :class:`RobotError` if it is refused."""

    def keep_latched(self, i_tag: str, sources: Sequence[str]) -> None:
        """The robot's sources at an interface other than these ended."""

    def refused(self, call: CallId, problem: str) -> None:
        """A message of a service call was refused before it could be handled."""

    async def ask_master(self, request: Request) -> tuple[str, ...]:
        """Have a request carried out; return what went wrong, as texts."""

    def joined(self, session: DoorSession) -> None:
        """The session can send now."""

    def leaving(self, session: DoorSession) -> None:
        """The session's connection ended; nothing can be sent any more."""

    def grew(self) -> None:
        """The session holds more bytes than before. May make it :meth:`DoorSession.shed`."""

    def left(self, session: DoorSession, reason: str) -> None:
        """Everything that the session received was handled. Its last word."""


class Door(Protocol):
    """A way by which robots come in."""

    def opened(self, admission: Admission) -> AbstractAsyncContextManager[None]:
        """Let robots in within the context; at its end their connections are closed."""
