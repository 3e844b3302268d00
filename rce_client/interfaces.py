"""The base of a program's interfaces; see :mod:`rce_client.topics`, :mod:`rce_client.services`.

They are named from the program's point of view, and by the engine from its own. A
:class:`~rce_client.topics.Publisher` here is an engine ``SubscriberConverter`` (or ``SubscriberForwarder``).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from rce.model import Form, InterfaceType, Role
from rce.protocol import NO_ID, DataMessage, Frame, encode_data

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Coroutine, Sequence


M_contra = TypeVar("M_contra", contravariant=True)


class InterfaceOwner(Protocol):
    """The connection that an interface belongs to, as the interface uses it."""

    def post_data(
        self, tag: str, frames: Sequence[Frame], key: str | None = None, queue_size: int | None = None
    ) -> bool:
        """Send a topic's message.

        Args:
            tag: The interface.
            frames: The message's frames.
            key: A queued message with a key is dropped only for a newer one of the same key.
            queue_size: Messages of the topic that may wait; None: as many as the limits allow.

        Returns:
            Whether there is a connection; without one nothing is sent.
        """

    def is_active(self, tag: str) -> bool:
        """Return whether an interface is connected to a peer."""

    @property
    def knows_sources(self) -> bool:
        """Whether the engine accepts the names of latched messages' sources."""

    @property
    def takes_single_frames(self) -> bool:
        """Whether the engine accepts serialized messages in one frame."""

    def post_control(self, frames: Sequence[Frame]) -> bool:
        """Send a service message; return False if that is not possible now."""

    def spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run a coroutine until the program closes the connection."""

    async def wait_active(self, tag: str, timeout: float | None = None) -> None:
        """Wait until an interface is connected to a peer."""

    async def withdraw(self, interface: ClientInterface) -> None:
        """Remove an interface."""


class LatchListener(Protocol[M_contra]):
    """Receives the latched messages of a topic, for a program that latches them again."""

    def received_latched(self, message: M_contra, source: str) -> None:
        """Handle a latched message, which replaces the last one of its source. Must not block."""

    def keep_latched(self, sources: Sequence[str]) -> None:
        """Forget the messages of all sources except these: the others ended."""


class ClientInterface(ABC):
    """Base of the four kinds of interfaces.

    Args:
        owner: The connection.
        tag: Interface tag.
        message_type: Message or service type, ``package/Type``.
        raw: Whether messages are serialized ROS messages.
    """

    role: Role
    """The engine's name for the role of this interface."""

    def __init__(self, owner: InterfaceOwner, tag: str, message_type: str, *, raw: bool) -> None:
        self._owner = owner
        self.tag = tag
        """Interface tag."""
        self.message_type = message_type
        """Message or service type, ``package/Type``."""
        self.raw = raw
        """Whether messages are serialized ROS messages."""

    @property
    def interface_type(self) -> str:
        """The interface type that the engine makes for it, such as ``SubscriberConverter``."""
        return str(InterfaceType(self.role, Form.FORWARDER if self.raw else Form.CONVERTER))

    def _frames(self, message: object, msg_id: str = NO_ID, latch: str = "") -> list[Frame]:
        single = self._owner.takes_single_frames
        return encode_data(self.tag, self.message_type, message, msg_id, latch, single=single)

    async def wait_active(self, timeout: float | None = None) -> None:
        """Wait until the interface is connected to a peer. Cancelling changes nothing.

        Args:
            timeout: Seconds; no limit if None.

        Raises:
            TimeoutError: It is not connected after ``timeout`` seconds; the text has the newest error texts.
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection.

        Example:
            ```python
            say = await robot.publisher("say", "std_msgs/String")
            await robot.connect("testRobot/say", "brain/names")
            await say.wait_active(timeout=30)
            ```
        """
        await self._owner.wait_active(self.tag, timeout)

    async def close(self) -> None:
        """Remove the interface and its connections.

        Iterations over it end, and service calls fail. Cancelling does not withdraw the removal.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection.

        Example:
            ```python
            say = await robot.publisher("say", "std_msgs/String")
            await say.close()
            ```
        """
        await self._owner.withdraw(self)

    # What the connection tells

    @abstractmethod
    def deliver(self, message: DataMessage) -> None:
        """Take a data message for this interface."""

    def fits(self, message: DataMessage) -> bool:
        """Return whether a message is for this interface, if an earlier one may have had its tag."""
        return (
            self.role is Role.PUBLISHER
            and message.message_type == self.message_type
            and self.raw is isinstance(message.msg, bytes | bytearray | memoryview)
        )

    def keep_latched(self, sources: Sequence[str]) -> None:  # noqa: B027 - subscribers only
        """Learn that the engine's sources other than these ended."""

    def on_active(self) -> None:  # noqa: B027 - few interfaces act on it
        """Learn that the interface is joined with a peer, or again."""

    def on_inactive(self) -> None:  # noqa: B027 - few interfaces act on it
        """Learn that the interface is not joined with a peer any more."""

    def on_lost(self) -> None:  # noqa: B027 - few interfaces act on it
        """Learn that the connection ended."""

    def on_fault(self, msg_id: str, text: str) -> None:  # noqa: B027 - services only
        """Learn of an ``ER`` that names a message of this interface, or that a message for it is lost."""

    def on_closed(self) -> None:  # noqa: B027 - few interfaces act on it
        """Learn that no more messages will come."""
