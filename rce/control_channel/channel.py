"""The task set's side of the control channel: dials the master, again after each loss.

One task, :meth:`TaskSetChannel.run`, owns everything. A connection starts with ``Hello``, which has the whole
state of the task set, so the channel keeps no reports while it is not connected. It keeps requests until they
are answered: they are idempotent, and are sent again on the next connection, marked as repeated.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, TypeVar, assert_never

import msgspec
from msgspec.structs import replace
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from rce.aio.tasks import TaskGroup
from rce.control import (
    ClientReply,
    ClientRequest,
    Drop,
    Execute,
    Hello,
    Login,
    LoginReply,
    MasterUnavailableError,
    Notify,
    PatchSpec,
    Probe,
    Put,
    ReadLog,
    Refused,
    RemoveVolume,
    RestoreVolume,
    SaveState,
    SaveVolume,
    StatusWanted,
    Sync,
    ToMaster,
    ToTaskSet,
    Unknown,
    UnsendableError,
    Welcome,
    decode_to_task_set,
    encode,
)
from rce.control_channel.connections import OpenConnections
from rce.control_channel.dialing import TaskSetConnection
from rce.control_channel.terms import Terms
from rce.control_channel.timeouts import DEFAULT_TIMEOUTS, MAX_FRAME, MAX_QUEUED, MAX_TEXT, ControlTimeouts
from rce.dialing import open_url_socket
from rce.masters import Masters
from rce.tls import CertificateError, Context, explain_to_client

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from websockets.asyncio.client import ClientConnection

    from rce.config import Secret
    from rce.model import Request

_log = logging.getLogger(__name__)

_MOST_SAID = 200
"""Bytes of an answer that are repeated in the log."""

Reply = TypeVar("Reply", LoginReply, ClientReply)


class _RefusedError(Exception):
    """The master refused the connection."""


class _OldTermError(Exception):
    """The master leads no more, and does not know it."""


class _Pending:
    """A request that waits for its answer."""

    def __init__(self, message: Login | ClientRequest, reply: asyncio.Future[Any]) -> None:
        self.reply = reply
        self._message = message
        self._text = _written(message)
        self._was_sent = False

    def take_text(self) -> str:
        """Return what is to be sent now; from the second time on, it says that it was sent before."""
        message = self._message
        if self._was_sent and isinstance(message, ClientRequest) and not message.repeated:
            self._message = replace(message, repeated=True)
            self._text = encode(self._message)
        self._was_sent = True
        return self._text


class TaskSetChannel:
    """The way to the master.

    Args:
        url: Where the master is, ``ws://host:8080`` (or ``wss://``); of several, the one that took this task
            set last is dialed first, and the others in turn.
        secret: Proves that this is a task set of the same engine.
        hello: Makes the first message of every connection: the current state of the task set.
        handler: Called with each message of the master but the answers to requests; one after the other, in
            order, and never cancelled by a lost connection. An exception from it is logged, and after a
            while the master is dialed again so that it says everything again.
        timeouts: Times of this end.
        tls: Gives the TLS context for each connection to a ``wss://`` URL.
        terms: Remembers the newest term of leadership, so that no master of an older one is listened to.
        connections: Those beside the channel, which end with the leadership of their master.
    """

    def __init__(
        self,
        url: str | Masters,
        secret: Secret,
        hello: Callable[[], Hello],
        handler: Callable[[ToTaskSet], Awaitable[None]],
        *,
        timeouts: ControlTimeouts = DEFAULT_TIMEOUTS,
        tls: Context | None = None,
        terms: Terms | None = None,
        connections: OpenConnections | None = None,
    ) -> None:
        self._connections = connections or OpenConnections()
        self._terms = terms or Terms()
        self._masters = url if isinstance(url, Masters) else Masters(url)
        self._url = self._masters.current
        self._tls = tls
        self._secret = secret
        self._hello = hello
        self._handler = handler
        self._timeouts = timeouts
        self._numbers = itertools.count(1)
        self._pending: dict[int, _Pending] = {}
        self._outbox: asyncio.Queue[str] | None = None  # there is one while there is a connection
        self._inbox: asyncio.Queue[ToTaskSet] = asyncio.Queue(MAX_QUEUED)
        self._socket: ClientConnection | None = None
        self._pauses = timeouts.backoff.start()
        self._told = ""
        """Why there was no connection, as the log has it."""
        self._handler_failed = False
        self._welcomed = asyncio.Event()
        self._worked = False
        """Whether this connection's master took this task set, and did not fall silent."""

    @property
    def connected(self) -> bool:
        """Whether the master has taken this task set and is there."""
        return self._welcomed.is_set()

    async def wait_connected(self) -> None:
        """Wait until :attr:`connected`."""
        await self._welcomed.wait()

    def send(self, message: ToMaster) -> None:
        """Send a message. Without a connection it is dropped: the next ``Hello`` has the whole state."""
        if self._outbox is None:
            return
        try:
            self._post(_written(message))
        except UnsendableError:
            _log.exception("a %s is left out", type(message).__name__)

    def _post(self, text: str) -> None:
        if self._outbox is None:
            return
        try:
            self._outbox.put_nowait(text)
        except asyncio.QueueFull:
            self._abort(f"{MAX_QUEUED} messages wait for the master")

    async def login(
        self, user: str, robot: str, password: str, address: str = "", token: str = ""
    ) -> LoginReply:
        """Ask whether a robot may come in, by the digest of its user's password or by its own token.

        Args:
            user: Whose robot it says that it is.
            robot: Its ID.
            password: As it sent it.
            address: Where it connects from.
            token: As it sent it, in place of a password.

        Raises:
            MasterUnavailableError: No answer in time.
            UnsendableError: It holds something that cannot be sent.
        """
        message = Login(
            request=next(self._numbers),
            user=user,
            robot=robot,
            password=password,
            address=address,
            token=token,
        )
        return await self._request(message, LoginReply)

    async def client_request(
        self,
        id: str,  # noqa: A002 - wire names
        type: str,  # noqa: A002
        data: Any = None,
        *,
        content: Request | None = None,
    ) -> ClientReply:
        """Have a client's request carried out.

        Args:
            id: Endpoint id of the robot that asks.
            type: ``CC``, ``RC``, ``DC``, ``CN`` or ``CX``.
            data: As the client sent it; for a master that does not know
                :data:`rce.control.messages.TYPED_REQUESTS`.
            content: The request, for a master that does.

        Raises:
            MasterUnavailableError: No answer in time.
            UnsendableError: It is too long, or holds something that cannot be sent.
        """
        message = ClientRequest(request=next(self._numbers), id=id, type=type, content=content, data=data)
        return await self._request(message, ClientReply)

    async def run(self) -> None:
        """Dial, talk, and dial again, until cancelled."""
        async with TaskGroup() as tasks:
            tasks.create_task(self._handle_inbox())
            while True:
                delay = await self._connect_once()
                await asyncio.sleep(delay)

    async def _request(self, message: Login | ClientRequest, kind: type[Reply]) -> Reply:
        # Written before it is kept: one that cannot be sent must fail here, and not on every connection.
        pending = _Pending(message, asyncio.get_running_loop().create_future())
        self._pending[message.request] = pending
        if self._outbox is not None:
            self._post(pending.take_text())
        try:
            await self._answered(pending)
        finally:
            del self._pending[message.request]
        reply = pending.reply.result()
        assert isinstance(reply, kind)
        return reply

    async def _answered(self, pending: _Pending) -> None:
        """Wait for an answer; longer of a master that is connected, and so has seen the request.

        Raises:
            MasterUnavailableError: No answer in time.
        """
        limit, waited = self._timeouts.request, 0.0
        while waited < self._timeouts.busy:
            await asyncio.wait((pending.reply,), timeout=limit)
            waited += limit
            if pending.reply.done():
                return
            if not self.connected:
                break
        raise MasterUnavailableError(waited)

    async def _connect_once(self) -> float:
        """Run one connection to its end, and choose the next master; return how long to wait, in seconds."""
        self._url = self._masters.current
        self._worked = False
        least = await self._connect()
        if not self._worked:
            self._masters.failed(self._url)
        if least or not self._masters.is_round_over:
            return least
        return self._pauses.next()

    async def _connect(self) -> float:
        """Run one connection to its end; return how long to wait at least before the next, in seconds."""
        shown = self._secret.reveal()
        try:
            timeouts = self._timeouts
            async with asyncio.timeout(timeouts.connect if self._masters.has_others else timeouts.open):
                sock = await open_url_socket(self._url)
            async with connect(
                self._url,
                sock=sock,
                additional_headers={"Authorization": f"Bearer {shown}"},
                ssl=None if self._tls is None else self._tls(),
                compression=None,
                proxy=None,
                open_timeout=self._timeouts.open,
                ping_interval=self._timeouts.master_ping_interval,
                ping_timeout=self._timeouts.ping_timeout,
                close_timeout=self._timeouts.close,
                max_size=MAX_FRAME,
                create_connection=TaskSetConnection,
            ) as socket:
                try:
                    await self._talk(socket)
                finally:
                    if isinstance(socket, TaskSetConnection) and socket.is_silent:  # hung, or cut off
                        self._worked = False
                        self._connections.note_silent(self._url)
                    await socket.close()  # a cancelled context manager would report an internal error
        except InvalidStatus as error:
            status = error.response.status_code
            if status in (HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN):
                if self._secret.was_refused(shown):
                    _log.info("the master at %s refuses one of our secrets; showing the other", self._url)
                    return 0.0
                _log.error("the master at %s refuses our secret (HTTP %d)", self._url, status)
                return self._timeouts.backoff_refused
            body = bytes(error.response.body or b"")[:_MOST_SAID].decode(errors="replace").strip()
            _log.warning("the master at %s answered HTTP %d: %s", self._url, status, body)
        except _RefusedError as error:
            _log.error("the master at %s refuses this task set: %s", self._url, error)
            return self._timeouts.backoff_refused
        except _OldTermError as error:
            _log.warning("the master at %s leads no more: %s", self._url, error)
        except (OSError, TimeoutError, WebSocketException, CertificateError) as error:
            self._tell(error)
        if self._handler_failed:  # it may fail again, so not at once
            self._handler_failed = False
            return self._timeouts.backoff_refused
        return 0.0

    def _tell(self, error: Exception) -> None:
        """Log why the connection failed: as a warning at first, and whenever the reason changes."""
        why = explain_to_client(error)
        words = why or str(error) or "no answer in time"
        level = logging.INFO if why is None else logging.ERROR
        if words == self._told:
            level = logging.DEBUG
        self._told = words
        _log.log(level, "no connection to the master at %s: %s", self._url, words)

    async def _talk(self, socket: ClientConnection) -> None:
        self._socket = socket
        outbox: asyncio.Queue[str] = asyncio.Queue(MAX_QUEUED)
        self._outbox = outbox
        failure: Exception | None = None
        try:
            async with TaskGroup() as tasks:
                writer = tasks.create_task(self._write(socket, outbox))
                await self._read(socket)
                writer.cancel()
        except* (ConnectionClosed, _RefusedError, _OldTermError) as group:
            failure = group.exceptions[0]
        finally:
            self._socket = self._outbox = None
            self._welcomed.clear()
            while not self._inbox.empty():  # the next connection's Sync says it all again
                self._inbox.get_nowait()
        if failure is not None:
            raise failure

    async def _write(self, socket: ClientConnection, outbox: asyncio.Queue[str]) -> None:
        # Hello is made in the same step in which sending begins to count, so no change falls between the two.
        hello = replace(self._hello(), term=self._terms.newest)
        first = [encode(hello), *(pending.take_text() for pending in self._pending.values())]
        while not outbox.empty():
            outbox.get_nowait()
        for text in first:
            await socket.send(text)
        while True:
            await socket.send(await outbox.get())

    async def _read(self, socket: ClientConnection) -> None:
        async for frame in socket:
            try:
                message = decode_to_task_set(frame)
            except (msgspec.MsgspecError, UnicodeError) as error:
                _log.error("the master sent garbage: %s", error)
                await socket.close(1007, "garbage")
                return
            await self._take(message)

    async def _take(self, message: ToTaskSet | Unknown) -> None:
        match message:
            case Unknown(name=name):
                _log.info("the master sent a %s, which this release does not know", name)
            case Welcome():
                if not self._terms.accept(message.term):
                    raise _OldTermError(f"its term is {message.term}, and {self._terms.newest} has begun")
                _log.info("connected to master %s at %s", message.master, self._url)
                self._pauses.reset()
                self._told = ""
                self._welcomed.set()
                self._worked = True
                self._masters.worked()
                self._connections.note_leader(self._url)
                await self._inbox.put(message)
            case Refused():
                raise _RefusedError(message.reason)
            case LoginReply() | ClientReply():
                pending = self._pending.get(message.request)
                if pending is not None and not pending.reply.done():
                    pending.reply.set_result(message)
            case (
                Sync()
                | Put()
                | PatchSpec()
                | StatusWanted()
                | Drop()
                | Notify()
                | Probe()
                | ReadLog()
                | RemoveVolume()
                | SaveVolume()
                | RestoreVolume()
                | SaveState()
                | Execute()
            ):
                await self._inbox.put(message)
            case _:
                assert_never(message)

    async def _handle_inbox(self) -> None:
        while True:
            message = await self._inbox.get()
            try:
                await self._handler(message)
            except Exception:  # noqa: BLE001 - one bad message must not end the task set
                _log.exception("%s from the master failed", type(message).__name__)
                self._handler_failed = True
                self._abort("a message from the master failed")

    def _abort(self, reason: str) -> None:
        """Abort the connection; the next one starts with Hello."""
        _log.warning("dialing the master again: %s", reason)
        if self._socket is not None:
            self._socket.transport.abort()


def _written(message: ToMaster) -> str:
    """Write a message as a frame that the master takes.

    Raises:
        UnsendableError: That is impossible.
    """
    try:
        text = encode(message)
    except (TypeError, ValueError, OverflowError) as error:
        raise UnsendableError(str(error)) from error
    if len(text) > MAX_TEXT:
        raise UnsendableError(f"its {len(text)} characters are more than {MAX_TEXT}")
    return text
