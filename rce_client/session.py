"""What stands behind a :class:`~rce_client.connection.Connection`: its state, its tasks, its memory."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any, Self, assert_never

from rce.aio.tasks import TaskScope
from rce.model import (
    ConfigureComponents,
    ConfigureConnections,
    CreateContainer,
    DestroyContainer,
    FaultCode,
    RemoveInterface,
    Request,
    ResizeContainer,
)
from rce.protocol import (
    LATCH,
    SINGLE_FRAME,
    DataMessage,
    ErrorReport,
    Event,
    Fault,
    Frame,
    InterfaceStatus,
    LargeData,
    LatchedSources,
    LongRequest,
    encode,
)
from rce_client.desired import Desired, merge_removals
from rce_client.engine_transport import EngineTransport, Target, Timing
from rce_client.exceptions import (
    ClientError,
    InUseError,
    LostError,
    NotConnectedError,
    RefusedError,
    UntrustedError,
)
from rce_client.interface_table import InterfaceTable
from rce_client.life import CONNECTION_LIFE, ConnectionEvent, State
from rce_client.parts import parts_of
from rce_client.reminder import Reminder
from rce_client.repetition import Repetition
from rce_client.sendqueue import QueueLimits

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence
    from types import TracebackType

    from rce_client.interfaces import ClientInterface

_log = logging.getLogger(__name__)

CONNECTING = "looking for the engine"
"""The words of the first report of an attempt; the reports of failures tell what went wrong."""

MAX_RECEIVED = 256
"""Most removals that are kept until it is sure that the engine did not drop them."""

REPORTED_WITHIN_S = 30.0
"""In this time after the engine received a request, it mostly has reported that it was not carried out."""


def _take_note(sent: asyncio.Future[None]) -> None:
    """Retrieve the error of a message: what is still wanted after the reconnect is sent again then."""
    if not sent.cancelled():
        sent.exception()


async def _until_sent(messages: list[asyncio.Future[None]]) -> None:
    """Wait until each message was handed to the network, or the connection ended."""
    for sent in messages:
        sent.add_done_callback(_take_note)
    if messages:
        await asyncio.wait(messages)


def is_failure(state: State, words: str) -> bool:
    """Return whether a report of a state says that an attempt to connect failed."""
    return state is State.CONNECTING and words != CONNECTING


class Session:
    """Keeps the connection, what was asked of the engine, and the interfaces, until the program closes it.

    Implements :class:`rce_client.interfaces.InterfaceOwner` and
    :class:`rce_client.engine_transport.Listener`.

    Args:
        target: The engine, and who connects.
        on_error: Called with the text of every ``ER`` that belongs to no service call; requests that a busy
            engine dropped are told together, with their number.
        on_state: Called with every new state and a few words.
        timing: Times in seconds and sizes in bytes.
        limits: How many messages and bytes may wait to be sent.
    """

    def __init__(
        self,
        target: Target,
        *,
        on_error: Callable[[str], None] | None = None,
        on_state: Callable[[State, str], None] | None = None,
        timing: Timing | None = None,
        limits: QueueLimits | None = None,
    ) -> None:
        self.robot = target.robot
        self._life = CONNECTION_LIFE.start(State.CLOSED, target.robot)
        self.errors: deque[str] = deque(maxlen=100)
        """The newest error texts."""
        self.transport = EngineTransport(target, self, timing, limits)
        self.desired = Desired()
        self.interfaces = InterfaceTable()
        self._on_error = on_error
        self._on_state = on_state
        self._tasks: TaskScope | None = None
        self._waiters: set[asyncio.Future[None]] = set()
        self._unconfirmed: dict[object, Request] = {}
        """Removals, and others that :attr:`desired` does not restore, which the engine may not have received;
        oldest first."""
        self._received: deque[tuple[float, Request]] = deque(maxlen=MAX_RECEIVED)
        """Those that the engine received lately, and when; oldest first."""
        self._maybe_dropped: dict[object, Request] = {}
        """Those that it may have dropped, until they are sent again; oldest first."""
        self._repetition = Repetition(self.spawn, self._repeat_all, self._tell_dropped)
        self._was_connected = False
        self._refusal: RefusedError | None = None
        self._reminder = Reminder()

    @property
    def state(self) -> State:
        """Where the connection is in its life."""
        return self._life.state

    async def __aenter__(self) -> Self:
        """Connect, and wait until it is done."""
        self._tasks = await TaskScope().__aenter__()
        self.spawn(self._run())
        try:
            await self.until(lambda: self._was_connected)
        except BaseException as error:
            await self.__aexit__(type(error), error, error.__traceback__)
            raise
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Send what waits, unless there was an exception, and close."""
        assert self._tasks is not None
        try:
            if exc is None:
                await self.transport.flush()
        finally:
            await self._close(self._tasks, exc_type, exc, traceback)

    async def _close(
        self,
        tasks: TaskScope,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.interfaces.close()
        try:
            await tasks.__aexit__(exc_type, exc, traceback)
        finally:
            self._tasks = None
            self._happen(ConnectionEvent.CLOSE, "closed")

    async def request(self, request: Request) -> None:
        """Send a request, and remember it for reconnects."""
        self.check_open()
        self.desired.apply(request)
        # All parts at once: if this is cancelled, none is left out.
        await _until_sent(
            [self.transport.deliver(encode(part), self._keep(part)) for part in parts_of(request)]
        )

    async def repeat(self) -> None:
        """Send all stored requests again; without a connection none, :meth:`on_connected` sends them."""
        self.check_open()
        if self.transport.connected:
            # All at once: what the program removes while they wait is removed after them.
            parts = [part for request in self.desired.restore() for part in parts_of(request)]
            await _until_sent([self.transport.deliver(encode(part)) for part in parts])

    def check_open(self) -> None:
        """Raise unless the program may use the connection.

        Raises:
            RefusedError: The engine refused this client for good.
            NotConnectedError: The program closed the connection, or has not opened it yet.
        """
        if self._refusal is not None:
            raise self._refusal
        if self._tasks is None:
            raise NotConnectedError("the connection is not open")

    async def until(self, done: Callable[[], bool]) -> None:
        """Wait until ``done`` returns true; it is called after every change of state or interface.

        Raises:
            RefusedError: The engine refused this client for good.
            NotConnectedError: The program closed the connection, or has not opened it yet.
        """
        while not done():
            self.check_open()
            waiter: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            self._waiters.add(waiter)
            try:
                await waiter
            finally:
                self._waiters.discard(waiter)

    # What the interfaces use: rce_client.interfaces.InterfaceOwner

    def post_data(
        self, tag: str, frames: Sequence[Frame], key: str | None = None, queue_size: int | None = None
    ) -> bool:
        """Send a topic's message; return False if there is no connection."""
        return self.transport.post_data(tag, frames, key, queue_size)

    def is_active(self, tag: str) -> bool:
        """Return whether an interface is joined with a peer."""
        return self.interfaces.active.get(tag, False)

    @property
    def knows_sources(self) -> bool:
        """Whether the engine takes the names of latched messages' sources."""
        return LATCH in self.transport.features

    @property
    def takes_single_frames(self) -> bool:
        """Whether the engine takes serialized messages in one frame."""
        return SINGLE_FRAME in self.transport.features

    def post_control(self, frames: Sequence[Frame]) -> bool:
        """Send a service message; return False if that is not possible now."""
        return self.transport.post_control(frames)

    def spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run a coroutine until the program closes the connection.

        Raises:
            NotConnectedError: The connection is not open.
        """
        if self._tasks is None:
            work.close()
            raise NotConnectedError("the connection is not open")
        return self._tasks.spawn(work, name=f"connection of {self.robot}")

    async def wait_active(self, tag: str, timeout: float | None = None) -> None:
        """Wait until an interface is joined with a peer."""
        try:
            async with asyncio.timeout(timeout):
                await self.until(lambda: self.is_active(tag))
        except TimeoutError as error:
            said = "; ".join(list(self.errors)[-3:])
            hint = f" The engine said: {said}" if said else ""
            raise TimeoutError(
                f"interface {tag} did not become active within {timeout:g} s.{hint}"
            ) from error

    async def withdraw(self, interface: ClientInterface) -> None:
        """Remove an interface."""
        if self.interfaces.withdraw(interface):
            removed = RemoveInterface(endpoint=self.robot, tag=interface.tag)
            await self.request(ConfigureComponents(remove_interfaces=(removed,)))

    # What the transport tells: rce_client.engine_transport.Listener

    def on_connecting(self) -> None:
        """Learn that an attempt to connect begins."""
        self._happen(ConnectionEvent.DIAL, CONNECTING)

    def on_failure(self, error: ClientError) -> None:
        """Learn that it failed; without ``on_state``, log what only a person can repair."""
        repairable = isinstance(error, (InUseError, UntrustedError))
        if self._on_state is None and repairable and self._reminder.is_due(str(error)):
            _log.warning("%s: %s", self.robot, error)
        self._happen(ConnectionEvent.FAIL, str(error))

    def on_connected(self) -> None:
        """Remove again what the engine may not have removed, and ask again for everything that was made."""
        for key, request in self._unconfirmed.items():
            self.transport.post_request(encode(request), partial(self._confirm, key))
        for request in self.desired.restore():
            for part in parts_of(request):
                self.transport.post_request(encode(part))
        event = ConnectionEvent.RESTORE if self._was_connected else ConnectionEvent.CONNECT
        self._was_connected = True
        self._happen(event, "connected")

    def on_lost(self, error: LostError) -> None:
        """Learn that the connection broke."""
        self._reclaim()
        self.interfaces.lose()
        self._happen(ConnectionEvent.LOSE, str(error))

    def on_event(self, event: Event) -> None:
        """Take what came from the engine."""
        match event:
            case DataMessage():
                self.interfaces.deliver(event)
            case InterfaceStatus():
                self.interfaces.set_active(event.i_tag, event.status)
                self._notify()
            case LatchedSources():
                self.interfaces.keep_latched(event.i_tag, event.sources)
            case ErrorReport():
                self._take_report(event)
            case Fault():
                self._take_fault(event)
            case (
                CreateContainer()
                | ResizeContainer()
                | DestroyContainer()
                | ConfigureComponents()
                | ConfigureConnections()
                | LargeData()
                | LongRequest()
            ):
                self._take_error(f"unexpected message {type(event).__name__}: only clients send it")
            case _:
                assert_never(event)

    # Own

    async def _run(self) -> None:
        try:
            await self.transport.run()
        except RefusedError as error:
            self._refusal = error
            self.interfaces.close()
            self._happen(ConnectionEvent.REFUSE, str(error))

    def _keep(self, request: Request) -> Callable[[], object] | None:
        """Keep what no restoring repeats; return what forgets it again, when the engine has received it."""
        unrestored = self.desired.unrestored(request)
        if unrestored is None:
            return None
        key = object()
        self._unconfirmed[key] = unrestored
        return partial(self._confirm, key)

    def _confirm(self, key: object) -> None:
        """Learn that the engine received a request that no restoring repeats."""
        request = self._unconfirmed.pop(key, None)
        if request is not None and key not in self._maybe_dropped:
            self._received.append((asyncio.get_running_loop().time(), request))

    def _take_drop(self) -> None:
        """Learn that the engine dropped a request: repeat all, with the removals that it may have been.

        No older removal is repeated: another program may have made a thing of that name since.
        """
        since = asyncio.get_running_loop().time() - REPORTED_WITHIN_S
        self._maybe_dropped.update((object(), request) for at, request in self._received if at >= since)
        self._received.clear()
        self._maybe_dropped.update(self._unconfirmed)
        self._repetition.note_drop()

    def _reclaim(self) -> dict[object, Request]:
        """Count what the engine may have dropped as not received, in few requests; return these."""
        for key in self._maybe_dropped:
            self._unconfirmed.pop(key, None)
        again: dict[object, Request] = {
            object(): part
            for request in merge_removals(self._maybe_dropped.values())
            for part in parts_of(request)
        }
        self._maybe_dropped.clear()
        self._unconfirmed = again | self._unconfirmed
        return again

    async def _repeat_all(self) -> None:
        """Send all requests again that the engine may have dropped; after a reconnect, what is desired."""
        if self._refusal is not None:
            return
        for key, request in self._reclaim().items():
            sent = self.transport.deliver(encode(request), partial(self._confirm, key))
            sent.add_done_callback(_take_note)
        await self.repeat()

    def _take_fault(self, fault: Fault) -> None:
        """Report what came and cannot be read; fail the service call that it was part of."""
        text = f"unreadable: {fault.text}"
        if fault.call is None or not self.interfaces.fail(fault.call.i_tag, fault.call.msg_id, text):
            self._take_error(text)

    def _take_report(self, report: ErrorReport) -> None:
        call = self.interfaces.call_of(report)
        if call is None:
            if report.code is FaultCode.BUSY:
                self._take_drop()
            else:
                self._take_error(report.text)
        else:
            self.interfaces.fail(call.i_tag, call.msg_id, report.text.removeprefix(f"{call}: "))

    def _tell_dropped(self, dropped: int) -> None:
        requests = "1 request was" if dropped == 1 else f"{dropped} requests were"
        self._take_error(f"{requests} not carried out, because the engine is busy; all are sent again")

    def _take_error(self, text: str) -> None:
        self.errors.append(text)
        if self._on_error is not None:
            self._on_error(text)
        else:
            _log.warning("engine: %s", text)

    def _happen(self, event: ConnectionEvent, words: str) -> None:
        state = self._life.advance(event)
        if self._on_state is not None:
            self._on_state(state, words)
        self._notify()

    def _notify(self) -> None:
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)
