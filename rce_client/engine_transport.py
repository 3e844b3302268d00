"""Keeps a WebSocket to the engine: dials through the master, sends, receives, and dials again."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from typing import TYPE_CHECKING, Protocol
from urllib.parse import urlencode, urlsplit, urlunsplit

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from rce.aio.backoff import Backoff
from rce.aio.tasks import TaskScope
from rce.dialing import open_url_socket
from rce.liveness import Liveness, Outflow, Step
from rce.masters import Masters
from rce.protocol import (
    FEATURES,
    FEATURES_HEADER,
    FEATURES_KEY,
    SINGLE_FRAME,
    Event,
    Frame,
    Limits,
    ProtocolStream,
)
from rce_client.discovery import VERSION, locate
from rce_client.exceptions import ClientError, InUseError, LostError, RefusedError, UntrustedError
from rce_client.failures import judge
from rce_client.sendqueue import QueuedMessage, QueueLimits, SendQueue
from rce_client.socket import EngineSocket

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable, Sequence
    from socket import socket as Socket  # noqa: N812 - here, a socket is the WebSocket


_log = logging.getLogger(__name__)

IN_USE_DELAY = 3.0
"""Maximum seconds until the next attempt if another client has the robotID."""
_MOST_DOUBLINGS = 8
"""Of the time for a TCP connection, before ``open`` limits it anyway."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """The client's account and the engine's address."""

    url: str
    """The master, ``http://HOST:9000/`` or ``https://``; several, separated by commas, are used in turn."""
    user: str
    robot: str
    password: str = field(default="", repr=False)
    token: str = field(default="", repr=False)
    """The robot's own token, in place of its user's password."""
    version: str = VERSION
    tls: ssl.SSLContext | Callable[[], ssl.SSLContext] | None = None
    """For ``https`` and ``wss``, or what gives it for each connection; the system's settings if None."""

    def context(self) -> ssl.SSLContext | None:
        """Return the TLS settings for the next connection.

        Raises:
            CertificateError: They cannot be made.
        """
        return self.tls() if callable(self.tls) else self.tls

    def handshake(self, *, header: bool) -> tuple[str, dict[str, str]]:
        """Return query and headers of the WebSocket handshake; the password itself never leaves this machine.

        Args:
            header: Whether the endpoint takes the credential in a header. It stays out of the URL then, which
                proxies log.

        Raises:
            RefusedError: The client has only a token, and the endpoint does not accept tokens.
        """
        who = {"userID": self.user, "robotID": self.robot}
        digest = hashlib.sha256(self.password.encode()).hexdigest()
        if header:
            return urlencode(who), {"Authorization": f"Bearer {self.token or digest}"}
        if self.token:
            reason = (
                "this engine does not accept robots' tokens: update it, or use the user's password instead"
                " of the token"
            )
            raise RefusedError(HTTPStatus.UNAUTHORIZED, reason)
        return urlencode({**who, "password": digest}), {}


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Times in seconds, sizes in bytes."""

    locate: float = 10.0
    """Seconds for the master's answer."""
    locate_next: float = 5.0
    """The same if another master is named that has not failed yet."""
    connect: float = 3.0
    """Seconds for the TCP connection to one of several masters, or to the endpoint: a machine that is off
    answers nothing, and the next attempt may be sent to another one. Towards the endpoint they are doubled
    each second time, up to ``open``: a slow network needs more."""
    open: float = 25.0
    """Seconds for the WebSocket handshake; the endpoint itself may wait some seconds for the master."""
    ping_interval: float | None = 2.0
    """Seconds without a sign of life after which the engine is pinged; None for no pings."""
    ping_timeout: float | None = 4.0
    """Seconds without a sign of life after a ping; then the connection counts as lost. None for no limit. Any
    data is a sign of life, so a slow link needs no more (:mod:`rce.liveness`)."""
    close: float = 3.0
    """Seconds for the closing handshake."""
    flush: float = 5.0
    """Seconds for sending queued messages when the program closes the connection."""
    max_message: int = 64 << 20
    """Bytes of the largest message that is accepted from the engine."""
    write_buffer: tuple[int, int] = (128 << 10, 32 << 10)
    """High and low limit of the bytes in the socket. Above the first, messages wait in their queue, where
    others can overtake them; below the second, the next one is sent."""
    backoff: Backoff = Backoff(first=0.2, longest=15.0, jitter=1.0)
    """Pauses between attempts to connect."""


class Listener(Protocol):
    """Gets the events of an engine transport. Called in the event loop; must not block."""

    def on_connecting(self) -> None:
        """Learn that an attempt to connect begins."""

    def on_failure(self, error: ClientError) -> None:
        """Learn that an attempt failed.

        Another one follows, or :meth:`EngineTransport.run` ends with this error.
        """

    def on_connected(self) -> None:
        """Learn that the connection is established; messages posted from now on are sent."""

    def on_lost(self, error: LostError) -> None:
        """Learn that the connection ended."""

    def on_event(self, event: Event) -> None:
        """Handle an event from the engine."""


class _SilentError(Exception):
    """The engine gives no sign of life."""


async def _ping(socket: EngineSocket, outflow: Outflow) -> None:
    """Send a ping, which waits for its turn if much is being sent."""
    with contextlib.suppress(ConnectionClosed):
        await socket.ping()
        outflow.pinged()


def _confirm(on_received: Callable[[], object], pong: asyncio.Future[float]) -> None:
    """Tell of an answered ping; the connection may have ended instead."""
    if not pong.cancelled() and pong.exception() is None:
        on_received()


class EngineTransport:
    """A robot's transport to the engine; it reconnects when a connection is lost."""

    def __init__(
        self,
        target: Target,
        listener: Listener,
        timing: Timing | None = None,
        limits: QueueLimits | None = None,
    ) -> None:
        self._target = target
        self._masters = Masters(target.url)
        self._listener = listener
        self._timing = timing or Timing()
        self._queue = SendQueue(limits or QueueLimits())
        self._idle = asyncio.Event()
        self._idle.set()
        self.connected = False
        self._was_connected = False
        self._unreached = 0
        """Attempts one after the other in which the endpoint's machine did not answer."""
        self.features: frozenset[str] = frozenset()
        """Optional protocol features of this connection's endpoint."""
        self.dropped = self._queue.dropped
        """Interface tag to the number of its messages that found no room to wait."""

    async def run(self) -> None:
        """Connect again and again, until cancelled.

        An engine that was connected before and is not trusted any more (an expired certificate, say) is
        tried again: the operator can repair it while robots' programs run.

        Raises:
            RefusedError: The engine refuses this client.
        """
        pauses = self._timing.backoff.start()
        while True:
            self._listener.on_connecting()
            url = self._masters.current
            try:
                socket = await self._dial()
            except Exception as raised:
                error = judge(raised)
                self._listener.on_failure(error)
                repairable = self._was_connected and isinstance(error, UntrustedError)
                if isinstance(error, RefusedError) and not repairable:
                    raise error from raised
                if self._masters.current != url and not self._masters.is_round_over:
                    continue  # a pause for each round is enough: another master may lead
                delay = pauses.next()
                await asyncio.sleep(min(delay, IN_USE_DELAY) if isinstance(error, InUseError) else delay)
                continue
            pauses.reset()
            self._listener.on_lost(await self._use(socket))
            await asyncio.sleep(pauses.next())

    def post_data(
        self, tag: str, frames: Sequence[Frame], key: str | None = None, queue_size: int | None = None
    ) -> bool:
        """Send a topic's message when its turn comes; return False if there is no connection.

        Args:
            tag: The interface.
            frames: The message's frames.
            key: A queued message with a key is dropped only for a newer one of the same key.
            queue_size: Messages of the topic that may wait; None: as many as the limits allow.
        """
        if self.connected:
            self._idle.clear()
            self._queue.put_data(tag, QueuedMessage.of(frames, key), queue_size)
        return self.connected

    def post_control(self, frames: Sequence[Frame]) -> bool:
        """Send a message that must not be lost; return False without a connection or if the queue is full."""
        if not self.connected or self._queue.full:
            return False
        self.post_request(frames)
        return True

    def post_request(self, frames: Sequence[Frame], on_received: Callable[[], object] | None = None) -> None:
        """Send a message even if much waits already. For what the program waits for, or asks once.

        Args:
            frames: The message's frames.
            on_received: As for :meth:`deliver`.
        """
        self._idle.clear()
        queued = QueuedMessage.of(frames)
        queued.on_received = on_received
        self._queue.put_control(queued)

    def deliver(
        self, frames: Sequence[Frame], on_received: Callable[[], object] | None = None
    ) -> asyncio.Future[None]:
        """Send a message when its turn comes.

        Args:
            frames: The message's frames.
            on_received: Called when the engine has received the message: what the network took can still be
                lost with the connection.

        Returns:
            Done when the message was handed to the network; its exception is a :class:`LostError` if there is
            no connection, or it ended before.
        """
        queued = QueuedMessage.of(frames)
        queued.sent = asyncio.get_running_loop().create_future()
        queued.on_received = on_received
        if self.connected:
            self._idle.clear()
            self._queue.put_control(queued)
        else:
            queued.sent.set_exception(LostError("not connected"))
        return queued.sent

    async def flush(self) -> None:
        """Wait until nothing waits to be sent, at most :attr:`Timing.flush` seconds."""
        try:
            async with asyncio.timeout(self._timing.flush):
                await self._idle.wait()
        except TimeoutError:
            _log.warning("the engine does not read; messages that wait to be sent are lost")

    async def _dial(self) -> EngineSocket:
        target, timing, masters = self._target, self._timing, self._masters
        tls = target.context()
        url = masters.current
        try:
            found = await locate(
                url,
                target.user,
                version=target.version,
                tls=tls,
                timeout=min(timing.locate, timing.locate_next) if masters.has_untried else timing.locate,
                connect=timing.connect if masters.has_others else None,
            )
        except ClientError:
            masters.failed(url)
            raise
        masters.worked()
        parts = urlsplit(found.url)
        query, headers = target.handshake(header=found.takes_header)
        sock = await self._reach(found.url)
        socket = await connect(
            urlunsplit(parts._replace(query=f"{query}&{FEATURES_KEY}={','.join(sorted(FEATURES))}")),
            sock=sock,
            additional_headers=headers,
            ssl=(tls or True) if parts.scheme == "wss" else None,
            compression=None,  # costs more time than it saves for all but slow links
            proxy=None,
            max_size=timing.max_message,
            open_timeout=timing.open,
            ping_interval=None,
            close_timeout=timing.close,
            write_limit=timing.write_buffer,
            create_connection=EngineSocket,
        )
        assert isinstance(socket, EngineSocket)
        return socket

    async def _reach(self, url: str) -> Socket:
        limit = self._timing.connect * 2 ** min(self._unreached // 2, _MOST_DOUBLINGS)
        try:
            async with asyncio.timeout(min(limit, self._timing.open)):
                sock = await open_url_socket(url)
        except TimeoutError:
            self._unreached += 1
            raise
        self._unreached = 0
        return sock

    async def _use(self, socket: EngineSocket) -> LostError:
        """Send and receive until the connection ends; return why it did."""
        self.connected = self._was_connected = True
        told = socket.response.headers.get(FEATURES_HEADER, "") if socket.response is not None else ""
        self.features = FEATURES & set(told.split(","))
        error = LostError("the connection was closed")
        try:
            async with TaskScope() as tasks:
                tasks.spawn(self._write(socket), name="write to the engine")
                tasks.spawn(self._watch(socket, tasks), name="watch the engine")
                self._listener.on_connected()
                error = await self._read(socket)
        except* _SilentError as silent:
            error = LostError(str(silent.exceptions[0]))
        finally:
            self.connected = False
            self._queue.clear()
            self._idle.set()
            await socket.close()
        return error

    async def _read(self, socket: EngineSocket) -> LostError:
        limit = self._timing.max_message
        limits = Limits(max_text=limit, max_binary=limit)
        stream = ProtocolStream.for_client(limits, single=SINGLE_FRAME in self.features)
        now = asyncio.get_running_loop().time
        try:
            while True:
                frame = await socket.recv()
                for event in stream.feed(frame, now()):
                    self._listener.on_event(event)
                deadline = stream.next_deadline
                if deadline is not None and deadline <= now():
                    for event in stream.expire(now()):
                        self._listener.on_event(event)
        except ConnectionClosed as closed:
            reason = closed.rcvd.reason if closed.rcvd is not None else ""
            return LostError(reason or f"the connection ended: {closed}")

    async def _watch(self, socket: EngineSocket, tasks: TaskScope) -> None:
        """Ping the engine if nothing is heard of it.

        Raises:
            _SilentError: It does not answer.
        """
        timing = self._timing
        if timing.ping_interval is None:
            return
        liveness = Liveness(timing.ping_interval, timing.ping_timeout)
        outflow = Outflow(socket.transport)
        clock = asyncio.get_running_loop().time
        looked = clock()
        while True:
            await asyncio.sleep(liveness.period)
            now, heard = clock(), socket.heard
            socket.heard = False
            step = liveness.look(now - looked, heard=heard, moved=outflow.moved())
            looked = now
            if step is Step.PING:
                tasks.spawn(_ping(socket, outflow), name="ping the engine")
            elif step is Step.GIVE_UP:
                socket.transport.abort()
                raise _SilentError(f"the engine did not answer within {liveness.silent:.0f} s")

    async def _write(self, socket: EngineSocket) -> None:
        while True:
            queued = self._queue.pop()
            if queued is None:
                self._idle.set()
                queued = await self._queue.get()
            try:
                await socket.send_frames(queued.frames)
                if queued.sent is not None and not queued.sent.done():
                    queued.sent.set_result(None)
                if queued.on_received is not None:
                    pong = asyncio.ensure_future(await socket.ping())
                    pong.add_done_callback(partial(_confirm, queued.on_received))
            except ConnectionClosed:
                return
            finally:
                if queued.sent is not None and not queued.sent.done():
                    queued.sent.set_exception(LostError("the connection ended while the message was sent"))
