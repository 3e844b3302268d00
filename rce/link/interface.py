"""Interfaces, the ends of connections, and the ports they send through."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Protocol, TypeAlias

if TYPE_CHECKING:
    from rce.model import InterfaceSpec

Buffer: TypeAlias = bytes | bytearray | memoryview
"""A payload to send. It is not copied where that can be avoided: do not change it afterwards."""


class Port(Protocol):
    """An interface's access to its peers."""

    @property
    def spec(self) -> InterfaceSpec:
        """The interface's spec."""
        ...

    def send(self, payload: Buffer, *, latched: bool = False, source: str = "") -> None:
        """Send a message to every peer. For subscriber interfaces.

        Never blocks and never fails: where a peer's queue is full its oldest messages are dropped and
        counted. The newest latched message of each source is kept and sent to each peer that comes later,
        until :meth:`keep_latched` takes it back.

        Args:
            payload: The message.
            latched: Keep it.
            source: Names the publisher that a latched message is of.

        Raises:
            TypeError: The interface is not a subscriber.
        """
        ...

    def keep_latched(self, sources: Collection[str]) -> None:
        """Take back the latched messages of all sources but these: their publishers ended."""
        ...

    async def call(self, payload: Buffer, *, timeout: float | None = None) -> bytes:
        """Ask the peer and wait for its answer. For service provider interfaces.

        When the waiting task is cancelled, or time is up, the peer's work on the request is cancelled too.

        Args:
            payload: The request.
            timeout: In seconds; none is :attr:`~rce.link.settings.LinkTimeouts.call`.

        Raises:
            TypeError: The interface is not a service provider.
            NotConnectedError: No peer is connected.
            PeerFaultError: The peer answered with a fault.
            PeerLostError: The connection ended before the answer came.
            CallTimeoutError: No answer in time.
            OverloadedError: Too many calls wait, here or at the peer.
            MessageTooLargeError: The request is larger than a link carries.
        """
        ...


class Interface(ABC):
    """An end of connections: a ROS topic or service, a converter, a forwarder.

    :meth:`close` is called once for every interface that was made, also if :meth:`start` failed or was
    cancelled. No other method is called after it.
    """

    def __init__(self, port: Port) -> None:
        self.port = port

    @abstractmethod
    async def start(self) -> None:
        """Make the interface usable; its connections open when this returns. May be cancelled.

        Raises:
            InterfaceError: It cannot be made usable; the text is for the user. Its connections stay closed.
        """

    @abstractmethod
    async def close(self) -> None:
        """Release everything that the interface holds."""

    def receive(self, payload: bytes, *, latched: bool) -> None:
        """Take a peer's message. For publisher interfaces; must not block."""
        raise NotImplementedError(f"{type(self).__name__} takes no messages")

    def receive_latched(self, payload: bytes, source: str) -> None:
        """Take a peer's latched message, the newest of its source. For publisher interfaces."""
        del source
        self.receive(payload, latched=True)

    def unlatch(self, sources: Collection[str]) -> None:  # noqa: B027 - not every interface keeps messages
        """Forget the latched messages of sources: their publishers ended. For publisher interfaces."""

    async def serve(self, payload: bytes) -> Buffer:
        """Answer a peer's request. For service client interfaces; cancelled when the peer waits no more.

        Raises:
            Exception: Anything; its text is what the peer gets.
        """
        raise NotImplementedError(f"{type(self).__name__} serves no requests")

    def on_active(self, active: bool) -> None:  # noqa: B027 - not every interface needs it
        """Notice that the first connection was established or the last one lost. Must not block."""


InterfaceFactory: TypeAlias = Callable[[Port], Interface]
"""Makes the interface for a port's spec; may raise :class:`~rce.link.exceptions.InterfaceError`."""
