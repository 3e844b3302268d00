"""The interfaces of topics: :class:`Publisher` and :class:`Subscriber`."""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections import deque
from typing import TYPE_CHECKING, Generic, TypeVar

from rce.aio.tasks import pass_cancellation
from rce.model import Role
from rce.protocol import DataMessage, LatchedSources, encode
from rce_client.exceptions import InterfaceError
from rce_client.interfaces import ClientInterface, InterfaceOwner, LatchListener

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Sequence

    from rce.protocol import Frame


_log = logging.getLogger(__name__)

M = TypeVar("M")
"""The type of messages: ``dict[str, Any]`` with a converter, bytes-like with a forwarder."""


class Publisher(ClientInterface, Generic[M]):
    """Sends messages on a topic; created by :meth:`rce_client.Connection.publisher`.

    It keeps the last latched message of each source, and sends it again whenever the interface is
    connected to a peer. The engine sends it to peers that connect later.
    """

    role = Role.SUBSCRIBER

    def __init__(
        self,
        owner: InterfaceOwner,
        tag: str,
        message_type: str,
        *,
        raw: bool,
        queue_size: int | None = None,
    ) -> None:
        super().__init__(owner, tag, message_type, raw=raw)
        self._queue_size = queue_size
        self._latched: dict[str, M] = {}
        self._on_demand: Callable[[bool], None] | None = None

    def watch_demand(self, callback: Callable[[bool], None]) -> None:
        """Call a function whenever it changes whether the interface is connected to a peer.

        A program can make messages only while they are needed. Without a connection to the engine they are
        not needed.

        Args:
            callback: Called with whether messages are needed; must not block.

        Example:
            ```python
            picture = await robot.publisher("picture", "sensor_msgs/Image")
            picture.watch_demand(lambda needed: print("camera on" if needed else "camera off"))
            ```
        """
        self._on_demand = callback
        if self._owner.is_active(self.tag):
            callback(True)

    def publish(self, message: M, *, latch: str = "") -> bool:
        """Send a message. It never waits.

        Args:
            message: The message.
            latch: Name of a source, at most 64 characters: keep the message for later subscribers, instead
                of the last one of this source. Most programs need only one name, such as ``"1"``.

        Returns:
            False if there is no connection and the message was not sent; a latched message is sent when the
            interface is connected to a peer. On a slow connection the oldest queued messages are dropped;
            :attr:`rce_client.Connection.dropped` counts them.

        Raises:
            TypeError: The message cannot be written as JSON.

        Example:
            ```python
            say = await robot.publisher("say", "std_msgs/String")
            await say.wait_active(timeout=30)
            say.publish({"data": "hello"})
            ```
        """
        if not latch:
            return self._owner.post_data(self.tag, self._frames(message), queue_size=self._queue_size)
        frames = self._latched_frames(message, latch)
        self._latched[latch] = message
        return self._owner.is_active(self.tag) and self._owner.post_data(self.tag, frames, latch)

    def keep_latched(self, sources: Sequence[str]) -> None:
        """Withdraw the latched messages of all sources except these.

        Args:
            sources: The names of sources, as given to :meth:`publish`.

        Example:
            ```python
            floor = await robot.publisher("floor", "std_msgs/String")
            floor.publish({"data": "ground floor"}, latch="1")
            floor.keep_latched([])
            ```
        """
        for source in self._latched.keys() - set(sources):
            del self._latched[source]
        if self._owner.knows_sources:
            known = LatchedSources(i_tag=self.tag, sources=tuple(self._latched))
            self._owner.post_data(self.tag, encode(known), "")

    def on_active(self) -> None:
        """Send the latched messages again: the engine may not have them."""
        for source, message in self._latched.items():
            try:
                frames = self._latched_frames(message, source)
            except Exception:  # noqa: BLE001 - logged; the program has changed it since
                _log.exception("latched message of publisher %s", self.tag)
            else:
                self._owner.post_data(self.tag, frames, source)
        self.keep_latched(tuple(self._latched))
        self._tell_demand(needed=True)

    def on_inactive(self) -> None:
        """Report that messages are not needed."""
        self._tell_demand(needed=False)

    def on_lost(self) -> None:
        """Report that messages are not needed without a connection."""
        self._tell_demand(needed=False)

    def _tell_demand(self, *, needed: bool) -> None:
        if self._on_demand is not None:
            try:
                self._on_demand(needed)
            except Exception:  # noqa: BLE001 - logged; it must not end anything else
                _log.exception("callback of publisher %s", self.tag)

    def _latched_frames(self, message: M, source: str) -> list[Frame]:
        return self._frames(message, latch=source if self._owner.knows_sources else "")

    def deliver(self, message: DataMessage) -> None:
        """Ignore the message; the engine sends none to a publisher."""
        _log.warning("%s: a publisher got a message, msgID %s", self.tag, message.msg_id)


class Subscriber(ClientInterface, Generic[M]):
    """Receives messages of a topic, by a callback or with ``async for``.

    Created by :meth:`rce_client.Connection.subscriber`. A plain callback runs as messages arrive and must not
    block. Without a callback, or with an ``async`` one, messages wait in a queue of ``queue_size``. If it
    is full, the oldest message is dropped and counted in :attr:`dropped`. Exceptions of a
    callback are logged.

    Example:
        ```python
        heard = await robot.subscriber("heard", "std_msgs/String")
        async for message in heard:
            print(message["data"])
            break
        ```
    """

    role = Role.PUBLISHER

    def __init__(
        self,
        owner: InterfaceOwner,
        tag: str,
        message_type: str,
        *,
        raw: bool,
        callback: Callable[[M], Awaitable[None] | None] | None,
        queue_size: int,
        latches: LatchListener[M] | None = None,
    ) -> None:
        super().__init__(owner, tag, message_type, raw=raw)
        self._latches = latches
        self._callback = callback
        self._queue: deque[M] = deque(maxlen=queue_size)
        self._filled = asyncio.Event()
        self._closed = False
        self.dropped = 0
        """The number of messages dropped because the queue was full."""
        is_async = callback is not None and inspect.iscoroutinefunction(inspect.unwrap(callback))
        self._direct = callback is not None and not is_async
        self._pump = owner.spawn(self._feed()) if is_async else None

    def deliver(self, message: DataMessage) -> None:
        """Give a message to the callback or the queue, a latched one to its listener if there is one."""
        if message.latch and self._latches is not None:
            try:
                self._latches.received_latched(message.msg, message.latch)
            except Exception:  # noqa: BLE001 - logged; it must not end anything else
                _log.exception("listener of subscriber %s", self.tag)
            return
        if self._direct:
            assert self._callback is not None
            try:
                self._callback(message.msg)
            except Exception:  # noqa: BLE001 - logged; it must not end anything else
                _log.exception("callback of subscriber %s", self.tag)
            return
        if len(self._queue) == self._queue.maxlen:
            self.dropped += 1
        self._queue.append(message.msg)
        self._filled.set()

    def keep_latched(self, sources: Sequence[str]) -> None:
        """Tell the listener which sources are still there."""
        if self._latches is not None:
            try:
                self._latches.keep_latched(sources)
            except Exception:  # noqa: BLE001 - logged; it must not end anything else
                _log.exception("listener of subscriber %s", self.tag)

    async def __aiter__(self) -> AsyncIterator[M]:
        """Yield messages until the program closes the subscriber or the connection.

        The iteration continues after a reconnection. Cancelling loses no message: iterate again.

        Raises:
            InterfaceError: The subscriber has a callback.
        """
        if self._callback is not None:
            raise InterfaceError(f"{self.tag}: messages go to the callback")
        async for message in self._messages():
            yield message

    def on_closed(self) -> None:
        """End the iteration."""
        self._closed = True
        self._filled.set()
        if self._pump is not None:
            self._pump.cancel()

    async def _messages(self) -> AsyncIterator[M]:
        while True:
            while self._queue:
                yield self._queue.popleft()
            if self._closed:
                return
            self._filled.clear()
            await self._filled.wait()

    async def _feed(self) -> None:
        assert self._callback is not None
        async for message in self._messages():
            try:
                awaitable = self._callback(message)
                if awaitable is not None:
                    await awaitable
            except (Exception, asyncio.CancelledError) as error:  # noqa: BLE001 - as above
                pass_cancellation(error)
                _log.exception("callback of subscriber %s", self.tag)
