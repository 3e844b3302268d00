"""The program's ends of a robot's interfaces: publisher, subscriber, service client, service provider.

Their names are the program's view. The engine names the same interface from its own side, so a
:class:`Publisher` here is an engine ``SubscriberConverter`` (or ``SubscriberForwarder``).
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import re
import uuid
from abc import ABC, abstractmethod
from collections import deque
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from rce.model.names import Form, InterfaceType, Role
from rce.protocol.codec import encode, encode_data
from rce.protocol.messages import NO_ID, LatchedSources
from rce_client.exceptions import CallError, CallTimeoutError, InterfaceError, NotConnectedError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Sequence

    from rce.protocol.codec import Frame
    from rce.protocol.messages import DataMessage

_log = logging.getLogger(__name__)

M = TypeVar("M")
"""What messages look like: ``dict[str, Any]`` with a converter, bytes-like with a forwarder."""
M_contra = TypeVar("M_contra", contravariant=True)

_CALL_FAULT = re.compile(r"(?P<tag>\w+), msgID (?P<id>\w+): (?P<text>.*)", re.DOTALL)


class Way(Protocol):
    """What an end needs of its connection."""

    def post_data(self, tag: str, frames: Sequence[Frame], key: str | None = None) -> bool:
        """Send a topic's message; False if there is no connection.

        One with a key is not dropped in the queue but for a newer one of the same key.
        """

    def is_active(self, tag: str) -> bool:
        """Whether an interface is joined with a peer."""

    @property
    def knows_sources(self) -> bool:
        """Whether the engine takes the names of latched messages' sources."""

    @property
    def takes_single_frames(self) -> bool:
        """Whether the engine takes serialized messages in one frame."""

    def post_control(self, frames: Sequence[Frame]) -> bool:
        """Send a service message; False if that is not possible now."""

    def spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run something until the connection is closed by the program."""

    async def wait_active(self, tag: str, timeout: float | None = None) -> None:
        """Wait until an interface is joined with a peer."""

    async def withdraw(self, end: End) -> None:
        """Remove the interface."""


class LatchListener(Protocol[M_contra]):
    """Takes the latched messages of a topic, for a program that latches them again."""

    def received_latched(self, message: M_contra, source: str) -> None:
        """Take a latched message; it replaces the last one of its source. Must not block."""

    def keep_latched(self, sources: Sequence[str]) -> None:
        """Learn that all other sources ended, and what they latched with them."""


class End(ABC):
    """Base of the four ends."""

    role: Role
    """The engine's name for what this end does."""

    def __init__(self, way: Way, tag: str, cls: str, *, raw: bool) -> None:
        self._way = way
        self.tag = tag
        self.cls = cls
        self.raw = raw
        """Whether messages are serialized ROS messages."""

    @property
    def type(self) -> str:
        """The interface type that the engine makes for it."""
        return str(InterfaceType(self.role, Form.FORWARDER if self.raw else Form.CONVERTER))

    def _frames(self, message: object, msg_id: str = NO_ID, latch: str = "") -> list[Frame]:
        single = self._way.takes_single_frames
        return encode_data(self.tag, self.cls, message, msg_id, latch, single=single)

    async def wait_active(self, timeout: float | None = None) -> None:
        """Wait until a peer is connected; raises :class:`TimeoutError` after ``timeout`` seconds."""
        await self._way.wait_active(self.tag, timeout)

    async def close(self) -> None:
        """Remove the interface."""
        await self._way.withdraw(self)

    @abstractmethod
    def deliver(self, message: DataMessage) -> None:
        """Take a data message for this end."""

    def fits(self, message: DataMessage) -> bool:
        """Tell whether a message that came before this end was made is for it."""
        return (
            self.role is Role.PUBLISHER
            and message.message_type == self.cls
            and self.raw is isinstance(message.msg, bytes | bytearray | memoryview)
        )

    def keep_latched(self, sources: Sequence[str]) -> None:  # noqa: B027 - subscribers only
        """The engine's sources other than these ended."""

    def on_active(self) -> None:  # noqa: B027 - most ends need not care
        """The interface is joined with a peer, or again."""

    def on_lost(self) -> None:  # noqa: B027 - most ends need not care
        """The connection ended."""

    def on_fault(self, msg_id: str, text: str) -> None:  # noqa: B027
        """An ``ER`` names a message of this end, or a message for it is lost."""

    def on_closed(self) -> None:  # noqa: B027
        """Nothing will come any more."""


class Publisher(End, Generic[M]):
    """Sends messages on a topic.

    The last latched message of each source is kept, and sent again whenever the interface is joined with a
    peer; the engine gives it to the peers that come later.
    """

    role = Role.SUBSCRIBER

    def __init__(self, way: Way, tag: str, cls: str, *, raw: bool) -> None:
        super().__init__(way, tag, cls, raw=raw)
        self._latched: dict[str, M] = {}

    def publish(self, message: M, *, latch: str = "") -> bool:
        """Send a message; never waits.

        Args:
            message: The message.
            latch: Keep it for those who listen later, in place of the last one of this name. A program that
                publishes for itself needs only one name, such as ``"1"``; at most 64 characters.

        Returns:
            False if there is no connection now, and the message was not sent; a latched one is sent when the
            interface is joined with a peer. A slow connection drops the oldest messages that wait, which
            :attr:`rce_client.connection.Connection.dropped` counts.
        """
        if not latch:
            return self._way.post_data(self.tag, self._frames(message))
        self._latched[latch] = message
        return self._way.is_active(self.tag) and self._post(message, latch)

    def keep_latched(self, sources: Sequence[str]) -> None:
        """Take back what was latched under all names but these."""
        for source in self._latched.keys() - set(sources):
            del self._latched[source]
        if self._way.knows_sources:
            known = LatchedSources(i_tag=self.tag, sources=tuple(self._latched))
            self._way.post_data(self.tag, encode(known), "")

    def on_active(self) -> None:
        """Say again what is latched: the engine may have forgotten it, or never known."""
        for source, message in self._latched.items():
            self._post(message, source)
        self.keep_latched(tuple(self._latched))

    def _post(self, message: M, latch: str) -> bool:
        source = latch if self._way.knows_sources else ""
        return self._way.post_data(self.tag, self._frames(message, latch=source), latch)

    def deliver(self, message: DataMessage) -> None:
        """Ignore it; the engine sends nothing here."""
        _log.warning("%s: a publisher got a message, msgID %s", self.tag, message.msg_id)


class Subscriber(End, Generic[M]):
    """Receives messages of a topic: by a callback, or with ``async for``.

    A plain callback runs as messages come and must not block. Without a callback, or with an ``async`` one,
    messages wait in a queue of ``queue_size``, which forgets the oldest and counts it in :attr:`dropped`.
    """

    role = Role.PUBLISHER

    def __init__(
        self,
        way: Way,
        tag: str,
        cls: str,
        *,
        raw: bool,
        callback: Callable[[M], Awaitable[None] | None] | None,
        queue_size: int,
        latches: LatchListener[M] | None = None,
    ) -> None:
        super().__init__(way, tag, cls, raw=raw)
        self._latches = latches
        self._callback = callback
        self._queue: deque[M] = deque(maxlen=queue_size)
        self._filled = asyncio.Event()
        self._closed = False
        self.dropped = 0
        is_async = callback is not None and inspect.iscoroutinefunction(inspect.unwrap(callback))
        self._direct = callback is not None and not is_async
        self._pump = way.spawn(self._feed()) if is_async else None

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
        """Pass on which sources go on."""
        if self._latches is not None:
            self._latches.keep_latched(sources)

    async def __aiter__(self) -> AsyncIterator[M]:
        """Yield messages until the subscriber or the connection is closed by the program."""
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
            except Exception:  # noqa: BLE001 - logged; it must not end anything else
                _log.exception("callback of subscriber %s", self.tag)


class ServiceClient(End, Generic[M]):
    """Calls a service. Calls run side by side: ``await client(request)``."""

    role = Role.SERVICE_PROVIDER

    def __init__(self, way: Way, tag: str, cls: str, *, raw: bool) -> None:
        super().__init__(way, tag, cls, raw=raw)
        self._calls: dict[str, asyncio.Future[M]] = {}

    async def __call__(self, request: M, timeout: float = 30.0) -> M:
        """Call the service.

        Args:
            request: The request.
            timeout: Seconds to wait for the answer.

        Raises:
            NotConnectedError: There is no connection; nothing was sent.
            CallError: The engine or the provider says why it failed, or the connection broke.
            CallTimeoutError: No answer in time.
        """
        msg_id = uuid.uuid4().hex
        answer: asyncio.Future[M] = asyncio.get_running_loop().create_future()
        self._calls[msg_id] = answer
        try:
            if not self._way.post_control(self._frames(request, msg_id)):
                raise NotConnectedError(f"{self.tag}: not connected, or too much waits to be sent")
            async with asyncio.timeout(timeout):
                return await answer
        except TimeoutError as error:
            raise CallTimeoutError(f"{self.tag}: no answer within {timeout:g} s") from error
        finally:
            del self._calls[msg_id]

    def deliver(self, message: DataMessage) -> None:
        """Complete a call."""
        answer = self._calls.get(message.msg_id)
        if answer is None:
            _log.info("%s: an answer came too late, msgID %s", self.tag, message.msg_id)
        elif not answer.done():
            answer.set_result(message.msg)

    def on_fault(self, msg_id: str, text: str) -> None:
        """Fail a call."""
        answer = self._calls.get(msg_id)
        if answer is not None and not answer.done():
            answer.set_exception(CallError(f"{self.tag}: {text}"))

    def on_lost(self) -> None:
        """Fail all calls; whether they were carried out is not known."""
        for answer in self._calls.values():
            if not answer.done():
                answer.set_exception(CallError(f"{self.tag}: the connection broke before the answer came"))

    def on_closed(self) -> None:
        """Fail all calls."""
        self.on_lost()


class ServiceProvider(End, Generic[M]):
    """Answers calls with a handler; calls run side by side."""

    role = Role.SERVICE_CLIENT

    def __init__(
        self,
        way: Way,
        tag: str,
        cls: str,
        handler: Callable[[M], Awaitable[M] | M],
        *,
        raw: bool,
        max_calls: int,
    ) -> None:
        super().__init__(way, tag, cls, raw=raw)
        self._handler = handler
        self._max_calls = max_calls
        self._calls: set[asyncio.Task[None]] = set()

    def deliver(self, message: DataMessage) -> None:
        """Start to answer a call."""
        if len(self._calls) >= self._max_calls:
            self._answer(message.msg_id, f"the robot serves {self._max_calls} calls already")
            return
        task = self._way.spawn(self._serve(message))
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)

    def on_fault(self, msg_id: str, text: str) -> None:
        """Answer a request that cannot be read."""
        self._answer(msg_id, f"the robot could not read the request: {text}")

    def on_lost(self) -> None:
        """Give up what nobody waits for any more."""
        for task in self._calls:
            task.cancel()

    def on_closed(self) -> None:
        """Give up everything."""
        self.on_lost()

    async def _serve(self, message: DataMessage) -> None:
        try:
            made = self._handler(message.msg)
            answer: object = await made if inspect.isawaitable(made) else made
        except Exception as error:  # noqa: BLE001 - logged; it must not end anything else
            _log.exception("handler of service %s", self.tag)
            answer = f"{type(error).__name__}: {error}"  # a string is the engine's sign for a failure
        self._answer(message.msg_id, answer)

    def _answer(self, msg_id: str, answer: object) -> None:
        try:
            frames = self._frames(answer, msg_id)
        except TypeError as error:
            _log.exception("answer of service %s", self.tag)
            frames = self._frames(f"the answer cannot be sent: {error}", msg_id)
        if not self._way.post_control(frames):
            _log.warning("%s: no connection to send an answer on", self.tag)


def read_call_fault(text: str) -> tuple[str, str, str] | None:
    """Return interface tag, msgID and problem if an ``ER`` is about one message."""
    found = _CALL_FAULT.fullmatch(text)
    return None if found is None else (found["tag"], found["id"], found["text"])
