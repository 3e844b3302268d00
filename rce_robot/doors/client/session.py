"""One robot's connection, from handshake to end: handles its messages, and queues messages to it.

Data messages are handled directly when they arrive. Longer work runs in the session's task group: requests to
the master one after another, service calls concurrently.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Any, assert_never

from websockets.frames import CloseCode

from rce.aio.queues import OverflowPolicy
from rce.model import (
    ConfigureComponents,
    ConfigureConnections,
    CreateContainer,
    DestroyContainer,
    ResizeContainer,
)
from rce.protocol import (
    LATCH,
    SINGLE_FRAME,
    CallId,
    DataMessage,
    ErrorReport,
    Event,
    Fault,
    InterfaceStatus,
    LargeData,
    LatchedSources,
    Limits,
    LongRequest,
    ProtocolStream,
    encode,
    is_light,
    type_of,
    utf8_in_steps,
)
from rce_robot.doors.client.outbox import Outbox
from rce_robot.doors.client.waiting_requests import WaitingRequests
from rce_robot.doors.client.websocket import LARGE_PART, RobotSocket
from rce_robot.exceptions import RobotError
from rce_robot.outgoing import LatchedDelivery, Outgoing, Serialized

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Coroutine, Iterator, Sequence

    from rce_robot.doors.base import Owner, Queued
    from rce_robot.settings import SessionSettings

_log = logging.getLogger(__name__)

LARGE_TEXT = 1 << 20
"""Size in bytes from which texts are handled in steps, between which other users have their turns."""

MAX_PROBLEM = 4096
"""Maximum length of a problem in an ``ER`` about data, which may quote what the robot or a peer sent."""

MAX_REASON = 100
"""Maximum length of a reason in a close frame."""


class Session:
    """A connected robot.

    Implements :class:`rce_robot.doors.base.DoorSession`, and the ``Receiver`` of
    :mod:`rce_robot.doors.client.websocket`.

    Life: made in the handshake; :meth:`run` from its end on; :meth:`on_lost` when the connection ends, with
    or without a completed handshake; then waiting requests are carried out, and :attr:`ended` is set.
    """

    def __init__(
        self,
        socket: RobotSocket,
        owner: Owner,
        settings: SessionSettings,
        dropped: Counter[str],
        *,
        client: str = "",
        features: frozenset[str] = frozenset(),
    ) -> None:
        self._socket = socket
        self._owner = owner
        self._settings = settings
        self._drain_timeout = settings.drain_timeout
        limits = Limits(max_text=settings.max_text, max_binary=settings.max_message)
        self._single = SINGLE_FRAME in features
        self._stream = ProtocolStream.for_engine(limits, single=self._single)
        self._outbox = Outbox(settings.outbox, dropped)
        self._requests = WaitingRequests(owner, settings, self._send_report)
        self._pending_bytes = 0
        """Bytes of incomplete messages at the last check."""
        self._tasks: asyncio.TaskGroup | None = None
        self._calls: set[asyncio.Task[None]] = set()
        self._loop = asyncio.get_running_loop()
        self._now = self._loop.time
        self._reason = ""
        self._unsent = 0
        """Reports of errors for which there was no room."""
        self.features = features
        """The client's features beyond the first protocol; see :mod:`rce.protocol.http`."""
        self.client = client
        """The robot's address and the time of its connection."""
        self.lost = False
        """Whether the connection ended."""
        self.ended = asyncio.Event()
        """Set when the session has ended completely."""

    async def run(self) -> None:
        """Serve the robot until its connection has ended and its last requests are carried out."""
        try:
            async with asyncio.TaskGroup() as self._tasks:
                worker = self._tasks.create_task(self._requests.carry_out())
                if not self.lost:
                    self._watch()
                    self._owner.joined(self)
                await self._socket.wait_closed()
                for call in self._calls:
                    call.cancel()
                await asyncio.wait([worker], timeout=self._drain_timeout)
                worker.cancel()
        finally:
            self._tasks = None
            self._end()

    async def close(self, reason: str, *, elsewhere: bool = False, finishes: bool = False) -> None:
        """Close the connection and wait until the session has ended.

        Args:
            reason: For the robot.
            elsewhere: Whether the robot is to connect again, at another task set.
            finishes: Whether the requests that it has sent are carried out; else they are forgotten.
        """
        code = CloseCode.GOING_AWAY if elsewhere else CloseCode.POLICY_VIOLATION
        if not finishes:
            self._drain_timeout = 0.0
        await self._socket.close(code, reason[:MAX_REASON])
        await self.ended.wait()

    async def probe(self) -> bool:
        """Return whether the robot still answers or sends; end the connection if it does not.

        The answer comes when the session has ended, which takes as long as its last requests take.
        """
        if not self.lost:
            if await self._socket.probe(self._settings.probe_timeout):
                return True
            self._socket.abort()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._drain_timeout + self._settings.probe_timeout):
                await self.ended.wait()
        return not self.ended.is_set()

    def tick(self) -> None:
        """Drop messages that have been incomplete for too long; called every few seconds."""
        for event in self._stream.expire(self._now()):
            self._handle(event)

    # Memory

    @property
    def knows_sources(self) -> bool:
        """Whether the robot supports sources of latched messages."""
        return LATCH in self.features

    @property
    def held(self) -> int:
        """Bytes of waiting messages: to be sent, completed or carried out."""
        return self._socket.held + self._stream.pending_bytes + self._outbox.bytes + self._requests.bytes

    def shed(self, size: int) -> None:
        """Drop incomplete messages, then waiting ones, oldest first: about ``size`` bytes."""
        goal = self.held - size
        for event in self._stream.drop_oldest(size):
            self._handle(event)
        self._outbox.shed(max(0, self.held - goal))

    def fail(self, reason: str) -> None:
        """Drop the connection and all waiting messages, because of the robot's usage."""
        self._socket.fail(CloseCode.TRY_AGAIN_LATER, reason[:MAX_REASON])
        self._outbox.clear()
        self._stream.drop_oldest(self._stream.pending_bytes)

    # To the robot

    def send_data(self, tag: str, message: Queued, overflow: OverflowPolicy, queue_size: int = 0) -> bool:
        """Send in the data lane; False if the queue refuses or the connection ended."""
        if self._socket.writable and not self._outbox:
            self._write(message)
            return True
        taken = not self.lost and self._outbox.put_data(tag, message, overflow, queue_size)
        self._owner.grew()
        return taken

    def send_latched(self, tag: str, source: str, message: Queued, *, shared: bool) -> None:
        """Send the latched message of a source in the data lane, where it is not dropped."""
        if LATCH in self.features:
            message = LatchedDelivery(message, source)
        if self._socket.writable and not self._outbox:
            self._write(message)
        elif not self.lost:
            self._outbox.put_latched(tag, source, message, shared=shared)
            self._owner.grew()

    def send_sources(self, tag: str, sources: Sequence[str]) -> None:
        """Send an ``LT`` after earlier messages, to a client that supports it."""
        if LATCH not in self.features:
            return
        message = _outgoing(LatchedSources(i_tag=tag, sources=tuple(sources)))
        if self._socket.writable and not self._outbox:
            self._write(message)
        elif not self.lost:
            self._outbox.put_latched(tag, "", message, shared=False)
            self._owner.grew()

    def drop_latched(self, tag: str, source: str) -> None:
        """Drop the unsent latched message of a source."""
        self._outbox.drop_latched(tag, source)

    def await_binaries(self, large: LargeData, ids: Sequence[str]) -> LargeData | None:
        """Return a large message with its binary values, if they have come; else handle it when they have."""
        complete = None
        for event in self._stream.await_binaries(large, ids, self._now()):
            if type(event) is LargeData:
                complete = event
            else:
                self._handle(event)
        self._check_pending()
        return complete

    def send_urgent(self, message: Queued) -> bool:
        """Send in the control lane; False if that is full or the connection ended."""
        if self._socket.writable and not self._outbox:
            self._write(message)
            return True
        taken = not self.lost and self._outbox.put_control(message)
        self._owner.grew()
        return taken

    def report(self, problem: str, call: CallId | None = None) -> None:
        """Send an ``ER``; if the lane is full, drop and log it."""
        self._send_report(ErrorReport(problem=problem[:MAX_PROBLEM], call=call))

    def _send_report(self, report: ErrorReport) -> None:
        if self.send_urgent(_outgoing(report)):
            return
        self._unsent += 1
        if self._unsent.bit_count() == 1:  # at 1, 2, 4, 8, ...: a robot must not fill the log
            _log.info("%s: %d errors not sent, the last: %s", self.client, self._unsent, report.text)

    def show_active(self, tag: str, active: bool) -> None:
        """Send an ``ST``."""
        message = _outgoing(InterfaceStatus(i_tag=tag, status=active))
        if self._socket.writable and not self._outbox:
            self._write(message)
        elif not self.lost:
            self._outbox.put_state(tag, message)
            self._owner.grew()

    def discard(self, tag: str) -> None:
        """Drop the waiting messages of a removed interface."""
        self._outbox.discard(tag)

    def spawn(self, work: Coroutine[Any, Any, None]) -> bool:
        """Run a coroutine until the connection ends; return False if too many run already."""
        if self._tasks is None or self.lost or len(self._calls) >= self._settings.max_calls:
            work.close()
            return False
        task = self._tasks.create_task(self._guard(work))
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)
        return True

    # From the robot: rce_robot.doors.client.websocket.Receiver

    def on_text(self, text: bytes) -> Iterator[None] | None:
        """Handle a text frame, a large one or a long request in steps."""
        if len(text) >= LARGE_TEXT:
            return self._handle_in_steps(text)
        events = self._stream.feed_text(text, self._now())
        if _has_fault(events) and not all(utf8_in_steps(text)):
            self._refuse_text()
            return None
        return self._handle_events(events, len(text))

    def _handle_in_steps(self, text: bytes) -> Iterator[None]:
        light = is_light(text)
        yield
        events = self._stream.feed_text(text, self._now(), light=light)
        yield
        if _has_fault(events):
            for valid in utf8_in_steps(text):
                if not valid:
                    self._refuse_text()
                    return
                yield
        rest = self._handle_events(events, len(text))
        if rest is not None:
            yield from rest

    def _handle_events(self, events: Sequence[Event], size: int) -> Iterator[None] | None:
        for index, event in enumerate(events):
            if type(event) is LongRequest:
                return self._read_long(event, events[index + 1 :], size)
            self._handle(event, size)
        self._check_pending()
        return None

    def _read_long(self, request: LongRequest, others: Sequence[Event], size: int) -> Iterator[None]:
        """Read and handle a long request in steps, then other events."""
        self._handle((yield from request.read()), size)
        rest = self._handle_events(others, size)
        if rest is not None:
            yield from rest

    def _refuse_text(self) -> None:
        self._socket.fail(CloseCode.INVALID_DATA, "a text frame is not UTF-8")

    def on_binary(self, data: bytes) -> Iterator[None] | None:
        """Handle a binary frame, a long request that waited for it in steps."""
        return self._handle_events(self._stream.feed_binary(data, self._now()), 0)

    def on_part(self) -> None:
        """Count a large message that is still being received."""
        self._owner.grew()

    def on_writable(self) -> None:
        """Send waiting messages, as far as the connection takes them."""
        while self._socket.writable:
            message = self._outbox.pop()
            if message is None:
                return
            self._write(message)

    def on_lost(self, reason: str) -> None:
        """Stop sending, and let :meth:`run` come to its end."""
        self.lost = True
        self._reason = reason
        self._owner.leaving(self)
        self._requests.close()
        if self._tasks is None:
            self._end()

    # Private

    def _watch(self) -> None:
        if self._settings.ping_interval is not None:
            self._socket.watch(self._settings.ping_interval, self._settings.ping_timeout)

    def _end(self) -> None:
        if not self.ended.is_set():
            self.ended.set()
            self._owner.left(self, self._reason)

    def _check_pending(self) -> None:
        pending = self._stream.pending_bytes
        if pending > self._pending_bytes:
            self._owner.grew()
        self._pending_bytes = pending

    def _write(self, message: Queued) -> None:
        rendered = message.render()
        if rendered is None:
            return
        if not isinstance(rendered, Serialized):
            self._socket.write(rendered)
        elif self._single and not rendered.is_long:
            self._socket.write_binary(rendered.prefix, rendered.payload)
        else:
            self._socket.write(rendered.split())
        if rendered.size > LARGE_PART:
            self._owner.grew()

    def _handle(self, event: Event, size: int = 0) -> None:
        match event:
            case DataMessage():
                self._take(event)
            case LargeData():
                self._handle_large(event)
            case LongRequest():
                for _ in self._read_long(event, (), size):
                    pass
            case LatchedSources():
                self._owner.keep_latched(event.i_tag, event.sources)
            case Fault():
                self._send_report(event.report)
                if event.call is not None:
                    self._owner.refused(event.call, event.text)
            case ErrorReport() | InterfaceStatus():
                self.report(f"type: {type_of(event)} is not for clients to send")
            case (
                CreateContainer()
                | ResizeContainer()
                | DestroyContainer()
                | ConfigureComponents()
                | ConfigureConnections()
            ):
                self._requests.put(event, size)
            case _:
                assert_never(event)

    def _take(self, message: DataMessage) -> None:
        try:
            self._owner.take(message)
        except RobotError as error:
            self.report(error.problem, error.call)
        except Exception:  # noqa: BLE001 - logged; it must not end anything else
            _log.exception("data message at %s", message.i_tag)
            problem = "internal error; the engine's log tells more"
            fault = RobotError.at(message.i_tag, message.msg_id, problem)
            self.report(fault.problem, fault.call)

    def _handle_large(self, large: LargeData) -> None:
        try:
            self._owner.take_large(large)
        except RobotError as error:
            self.report(error.problem, error.call)

    async def _guard(self, work: Coroutine[Any, Any, None]) -> None:
        """Prevent a bug in one call from ending the session."""
        try:
            await work
        except Exception:  # noqa: BLE001 - logged; it must not end anything else
            _log.exception("service call")
            self.report("internal error in a service call; the engine's log tells more")


def _outgoing(message: ErrorReport | InterfaceStatus | LatchedSources) -> Outgoing:
    (text,) = encode(message)
    return Outgoing(text.encode() if isinstance(text, str) else text)


def _has_fault(events: Sequence[Event]) -> bool:
    return any(type(event) is Fault for event in events)
