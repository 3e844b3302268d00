"""A robot's, or any program's, connection to the engine.

::

    async with Connection("http://localhost:9000/", "testUser", "testUser", "testRobot") as conn:
        await conn.create_container("cTag_01")
        await conn.add_node("cTag_01", "echo", "Test", "stringEcho.py")
        ...
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from enum import Enum
from typing import TYPE_CHECKING, Any, NoReturn, Self, TypeVar

from rce.protocol.codec import encode
from rce.protocol.http import LATCH, SINGLE_FRAME
from rce.protocol.messages import NO_ID, DataMessage, ErrorReport, InterfaceStatus, LatchedSources
from rce.protocol.stream import Fault
from rce_client.desired import Desired
from rce_client.ends import ServiceClient, read_call_fault
from rce_client.engine_transport import EngineTransport, Target, Timing
from rce_client.exceptions import (
    InterfaceError,
    InUseError,
    LostError,
    NotConnectedError,
    RefusedError,
    UntrustedError,
)
from rce_client.own_interfaces import OwnInterfaces
from rce_client.reminder import Reminder
from rce_client.requests import Requests
from rce_client.sendqueue import QueueLimits

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable, Coroutine, Mapping, Sequence
    from types import TracebackType

    from rce.protocol.codec import Frame
    from rce.protocol.messages import Request
    from rce.protocol.stream import Event
    from rce_client.ends import End
    from rce_client.exceptions import ClientError

_log = logging.getLogger(__name__)

E = TypeVar("E", bound="End")
_MOST_EARLY = 64
"""Topics, and sources of latched ones, whose last message is kept until the program makes their interface."""

CONNECTING = "looking for the engine"
"""The words of the first report of an attempt; the reports of failures tell what went wrong."""


class State(Enum):
    """Where a connection is in its life."""

    CONNECTING = "connecting"
    """Looking for the engine, for the first time or again."""
    CONNECTED = "connected"
    """Connected for the first time."""
    LOST = "lost"
    """The connection broke; everything that was made is remembered."""
    RESTORED = "restored"
    """Connected again, and everything that was made was asked for again."""
    CLOSED = "closed"
    """Closed by the program, or refused by the engine for good."""


class Connection(Requests, OwnInterfaces):
    """A connection that stays: it dials again when it breaks, and restores what the program had made.

    Requests such as :meth:`create_container` return when they were handed to the network, or were noted for
    the reconnect while the connection is away. The protocol has no answer for success; what fails comes as
    an error text to ``on_error``.

    Args:
        url: The master, ``http://HOST:9000/`` or ``https://``.
        user_id: User ID.
        password: The user's password; only its SHA-256 is sent. Empty if there is a token.
        robot_id: Names this robot; one connection at a time.
        token: The robot's own token (``rce robot add``), in place of the user's password.
        tls: TLS settings, or what gives them for each connection; the system's if None.
        on_error: Called with the text of every ``ER`` that belongs to no service call.
        on_state: Called with every new state and a few words.
        timing: Times and sizes.
        limits: How much may wait to be sent.
    """

    def __init__(
        self,
        url: str,
        user_id: str,
        password: str,
        robot_id: str,
        *,
        token: str = "",
        tls: ssl.SSLContext | Callable[[], ssl.SSLContext] | None = None,
        on_error: Callable[[str], None] | None = None,
        on_state: Callable[[State, str], None] | None = None,
        timing: Timing | None = None,
        limits: QueueLimits | None = None,
    ) -> None:
        self.robot_id = robot_id
        self.on_error = on_error
        self.on_state = on_state
        self.state = State.CLOSED
        self.errors: deque[str] = deque(maxlen=100)
        """The newest error texts."""
        self.active: dict[str, bool] = {}
        """Own interface tags to whether they are joined with a peer."""
        target = Target(url=url, user=user_id, password=password, token=token, robot=robot_id, tls=tls)
        self._transport = EngineTransport(target, self, timing, limits)
        self._desired = Desired()
        self._ends: dict[str, End] = {}
        self._early: dict[tuple[str, str], DataMessage] = {}
        """The last message of each topic and source that came before its interface was made here."""
        self._withdrawn: set[str] = set()
        """Own interfaces that were removed; what still comes for them is of no use."""
        self._tasks: asyncio.TaskGroup | None = None
        self._work: set[asyncio.Task[Any]] = set()
        self._waiters: set[asyncio.Future[None]] = set()
        self._backlog: list[Request] = []
        self._was_connected = False
        self._refusal: RefusedError | None = None
        self._reminder = Reminder()

    async def __aenter__(self) -> Self:
        """Connect.

        Raises:
            RefusedError: The engine does not take this client. One that cannot be reached is waited for;
                put an ``asyncio.timeout`` around it to limit that.
        """
        self._tasks = await asyncio.TaskGroup().__aenter__()
        self.spawn(self._run())
        try:
            await self._until(lambda: self._was_connected)
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
        """Send what waits, then close. What was made in the engine stays there."""
        assert self._tasks is not None
        if exc is None:
            await self._transport.flush()
        for end in self._ends.values():
            end.on_closed()
        for task in list(self._work):
            task.cancel()
        try:
            if isinstance(exc, asyncio.CancelledError):
                await self._tasks.__aexit__(exc_type, exc, traceback)
            else:  # what the program raised is raised as it is, not in a group
                await self._tasks.__aexit__(None, None, None)
        finally:
            self._tasks = None
            self._set_state(State.CLOSED, "closed")

    @property
    def connected(self) -> bool:
        """Whether there is a connection at this moment."""
        return self._transport.connected

    @property
    def dropped(self) -> Mapping[str, int]:
        """Interface tag to the number of its messages that found no room to wait."""
        return self._transport.dropped

    # Requests

    async def request(self, request: Request) -> None:
        """Send any request, and remember it for reconnects."""
        self._check_open()
        self._desired.apply(request)
        try:
            await self._transport.deliver(encode(request))
        except LostError:
            self._backlog.append(request)

    async def remove_all(self) -> None:
        """Remove everything that was made through this connection."""
        for request in self._desired.undo():
            await self.request(request)

    async def repeat_requests(self) -> None:
        """Ask again for everything that was made, because something that it needs may be there by now."""
        for request in self._desired.restore():
            await self.request(request)

    # Own interfaces

    async def wait_active(self, tag: str, timeout: float | None = None) -> None:
        """Wait until an own interface is joined with a peer (``ST`` true).

        Raises:
            TimeoutError: It is not after ``timeout`` seconds; the newest error texts are in the text.
            RefusedError: The connection was closed for good.
        """
        try:
            async with asyncio.timeout(timeout):
                await self._until(lambda: self.active.get(tag, False))
        except TimeoutError as error:
            said = "; ".join(list(self.errors)[-3:])
            hint = f" The engine said: {said}" if said else ""
            raise TimeoutError(
                f"interface {tag} did not become active within {timeout:g} s.{hint}"
            ) from error

    async def wait_refused(self) -> NoReturn:
        """Wait until the engine refuses this client for good; any other loss is repaired meanwhile.

        Raises:
            RefusedError: It did.
            NotConnectedError: The program closed the connection.
        """
        while True:
            await self._until(lambda: False)

    # What the ends use: rce_client.ends.Way

    def post_data(self, tag: str, frames: Sequence[Frame], key: str | None = None) -> bool:
        """Send a topic's message; False if there is no connection."""
        return self._transport.post_data(tag, frames, key)

    def is_active(self, tag: str) -> bool:
        """Whether an interface is joined with a peer."""
        return self.active.get(tag, False)

    @property
    def knows_sources(self) -> bool:
        """Whether the engine takes the names of latched messages' sources."""
        return LATCH in self._transport.features

    @property
    def takes_single_frames(self) -> bool:
        """Whether the engine takes serialized messages in one frame."""
        return SINGLE_FRAME in self._transport.features

    def post_control(self, frames: Sequence[Frame]) -> bool:
        """Send a service message; False if that is not possible now."""
        return self._transport.post_control(frames)

    def spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run something until the connection is closed by the program."""
        if self._tasks is None:
            work.close()
            raise NotConnectedError("the connection is not open")
        task = self._tasks.create_task(work)
        self._work.add(task)
        task.add_done_callback(self._work.discard)
        return task

    async def withdraw(self, end: End) -> None:
        """Remove an own interface."""
        if self._ends.get(end.tag) is end:
            del self._ends[end.tag]
            self._withdrawn.add(end.tag)
            self.active.pop(end.tag, None)
            end.on_closed()
            await self.remove_interface(self.robot_id, end.tag)

    # What the transport tells: rce_client.engine_transport.Listener

    def on_connecting(self) -> None:
        """An attempt to connect begins."""
        self._set_state(State.CONNECTING, CONNECTING)

    def on_failure(self, error: ClientError) -> None:
        """It failed. A program that does not listen is told in the log what only a person can repair."""
        repairable = isinstance(error, (InUseError, UntrustedError))
        if self.on_state is None and repairable and self._reminder.is_due(str(error)):
            _log.warning("%s: %s", self.robot_id, error)
        self._set_state(State.CONNECTING, str(error))

    def on_connected(self) -> None:
        """Ask again for everything that was made."""
        for request in (*self._backlog, *self._desired.restore()):
            self._transport.post_request(encode(request))
        self._backlog.clear()
        state = State.RESTORED if self._was_connected else State.CONNECTED
        self._was_connected = True
        self._set_state(state, "connected")

    def on_lost(self, error: LostError) -> None:
        """Nothing is joined any more, as far as is known here."""
        self.active = dict.fromkeys(self.active, False)
        self._early.clear()
        for end in list(self._ends.values()):
            end.on_lost()
        self._set_state(State.LOST, str(error))

    def on_event(self, event: Event) -> None:
        """Something came from the engine."""
        match event:
            case DataMessage():
                end = self._ends.get(event.i_tag)
                if end is not None:
                    end.deliver(event)
                else:
                    self._keep(event)
            case InterfaceStatus():
                self.active[event.i_tag] = event.status
                if event.status and event.i_tag in self._ends:
                    self._ends[event.i_tag].on_active()
                self._notify()
            case LatchedSources():
                if event.i_tag in self._ends:
                    self._ends[event.i_tag].keep_latched(event.sources)
            case ErrorReport():
                self._take_error(event.text)
            case Fault():
                self._take_fault(event)
            case _:
                self._take_error(f"unexpected message {type(event).__name__}")

    # Own

    async def _run(self) -> None:
        try:
            await self._transport.run()
        except RefusedError as error:
            self._refusal = error
            for end in self._ends.values():
                end.on_closed()
            self._set_state(State.CLOSED, str(error))

    @property
    def _way(self) -> Self:
        return self

    async def _add_end(self, end: E) -> E:
        self._check_open()
        if end.tag in self._ends:
            end.on_closed()
            raise InterfaceError(f"interface {end.tag} is there already")
        self._ends[end.tag] = end
        for key in [key for key in self._early if key[0] == end.tag]:
            early = self._early.pop(key)
            if end.fits(early):
                end.deliver(early)
        await self.add_interface(self.robot_id, end.tag, end.type, end.cls)
        return end

    def _keep(self, message: DataMessage) -> None:
        """Keep what comes for an interface that this program has not made yet.

        The engine gives a robot that returns the latched messages of its interfaces at once, also if another
        program, or an earlier life of this one, made them.
        """
        if message.msg_id == NO_ID and message.i_tag not in self._withdrawn:
            key = message.i_tag, message.latch
            self._early.pop(key, None)
            self._early[key] = message
            if len(self._early) > _MOST_EARLY:
                del self._early[next(iter(self._early))]

    def _take_fault(self, fault: Fault) -> None:
        """Tell of what came and cannot be read; a service call that it was part of fails."""
        end = None if fault.call is None else self._ends.get(fault.call.i_tag)
        if fault.call is not None and end is not None:
            end.on_fault(fault.call.msg_id, f"unreadable: {fault.text}")
        if not isinstance(end, ServiceClient):
            self._take_error(f"unreadable: {fault.text}")

    def _take_error(self, text: str) -> None:
        fault = read_call_fault(text)
        end = None if fault is None else self._ends.get(fault[0])
        if fault is not None and isinstance(end, ServiceClient):
            end.on_fault(fault[1], fault[2])
            return
        self.errors.append(text)
        if self.on_error is not None:
            self.on_error(text)
        else:
            _log.warning("engine: %s", text)

    def _set_state(self, state: State, words: str) -> None:
        self.state = state
        if self.on_state is not None:
            self.on_state(state, words)
        self._notify()

    def _check_open(self) -> None:
        if self._refusal is not None:
            raise self._refusal
        if self._tasks is None:
            raise NotConnectedError("the connection is not open")

    async def _until(self, done: Callable[[], bool]) -> None:
        while not done():
            self._check_open()
            waiter: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            self._waiters.add(waiter)
            try:
                await waiter
            finally:
                self._waiters.discard(waiter)

    def _notify(self) -> None:
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)
