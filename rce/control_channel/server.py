"""The master's side of the control channel: task sets dial in, one :class:`Peer` each."""

from __future__ import annotations

import asyncio
import logging
from http import HTTPStatus
from typing import TYPE_CHECKING, assert_never
from weakref import WeakKeyDictionary

import msgspec
from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed

from rce.aio.tasks import finish
from rce.control import (
    ACCEPTED_VERSIONS,
    CONTROL_VERSION,
    ClientRequest,
    Fault,
    Gone,
    Hello,
    Left,
    LogChunk,
    Login,
    PatchStatus,
    PeerRefusedError,
    Refused,
    SpecWanted,
    StateSaved,
    Status,
    ToMaster,
    Unknown,
    Usage,
    VolumeRemoved,
    VolumeRestored,
    VolumeSaved,
    Welcome,
    decode_to_master,
    encode,
)
from rce.control.execution import run_of
from rce.control.node_states import PATH as NODE_STATES_PATH
from rce.control.snapshots import UPLOADS
from rce.control_channel.contents import ReadContent, answer, is_for_contents
from rce.control_channel.peer import Peer
from rce.control_channel.timeouts import DEFAULT_TIMEOUTS, MAX_FRAME, ControlTimeouts
from rce.guard import PER_ADDRESS, Lobby
from rce.guard.websocket import GuardedConnection, guarded
from rce.liveness.websocket import WatchedConnection
from rce.tls.gate import TlsGate
from rce.tls.websocket import behind_gate

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from types import TracebackType
    from typing import Self

    from websockets.asyncio.server import Server, ServerConnection
    from websockets.http11 import Request, Response

    from rce.config import Secret
    from rce.tls import Context

_log = logging.getLogger(__name__)

UNAUTHENTICATED_PER_ADDRESS = PER_ADDRESS
"""Connections from one address that have not shown the secret yet."""

PROOF_CHECK_S = 1.0
"""Seconds between checks whether the secrets and certificates of connected task sets are still accepted."""

_GARBAGE, _POLICY, _INTERNAL, _GOING_AWAY = 1007, 1008, 1011, 1001
_MAX_REASON = 123  # bytes of a WebSocket close frame's reason


class MasterConnection(WatchedConnection, GuardedConnection):
    """The master's end of a connection, which watches the task set for signs of life."""


class ControlServer:
    """Accepts task sets. An async context manager: listens inside.

    Callbacks are awaited one after the other for each peer, so a slow one slows that peer only. An exception
    from a callback is logged and ends only that peer's connection.

    Args:
        secret: What task sets must prove to have.
        on_hello: A task set connected. Messages that it sends to the peer follow ``Welcome``. May raise
            :class:`PeerRefusedError`; then no other callback is called for that peer.
        on_message: A task set sent something (answers to :meth:`Peer.read_log` are not passed on).
        on_gone: A task set that ``on_hello`` took has left, however it ended.
        master: This master's name, for the task sets' logs.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.
        timeouts: Times of this end.
        contents: Gives contents to task sets that ask for them (:mod:`rce.control_channel.contents`).
        tls: Gives the TLS context for each connection, which demands the task sets' certificates; none for a
            plain channel.
        is_revoked: Tells by its serial number whether a task set's certificate was revoked.
        on_node_state: Takes a connection that a task set dialed for a snapshot of a node's state
            (:mod:`rce.control.node_states`), and returns when it is done with it.
        on_execution: Takes a connection that a task set dialed for a run (:mod:`rce.control.execution`), and
            returns when it is done with it.
        on_upload: The same for a connection to send a snapshot (:mod:`rce.control.snapshots`).
        is_fenced: Tells that another master may lead by now. Then nothing is sent to task sets any more,
            nor taken from them: they are dismissed, to dial the next one.
        term: The term of leadership in which this master talks; 0: there are no other masters.
    """

    def __init__(
        self,
        secret: Secret,
        *,
        on_hello: Callable[[Peer, Hello], Awaitable[None]],
        on_message: Callable[[Peer, ToMaster], Awaitable[None]],
        on_gone: Callable[[Peer], Awaitable[None]],
        master: str = "master",
        host: str = "127.0.0.1",
        port: int = 8080,
        timeouts: ControlTimeouts = DEFAULT_TIMEOUTS,
        contents: ReadContent | None = None,
        tls: Context | None = None,
        is_revoked: Callable[[int], bool] | None = None,
        on_execution: Callable[[str, ServerConnection], Awaitable[None]] | None = None,
        on_upload: Callable[[ServerConnection], Awaitable[None]] | None = None,
        on_node_state: Callable[[ServerConnection], Awaitable[None]] | None = None,
        features: tuple[str, ...] = (),
        is_fenced: Callable[[], bool] | None = None,
        term: int = 0,
    ) -> None:
        self._is_fenced = is_fenced
        self._term = term
        self._features = features
        self._secret = secret
        self._tls = tls
        self._is_revoked = is_revoked
        self._gate: TlsGate | None = None
        self._contents = contents
        self._on_execution = on_execution
        self._on_upload = on_upload
        self._on_node_state = on_node_state
        self._on_hello = on_hello
        self._on_message = on_message
        self._on_gone = on_gone
        self._master = master
        self._host = host
        self._port = port
        self._timeouts = timeouts
        self._peers: dict[str, Peer] = {}
        self._shown: WeakKeyDictionary[ServerConnection, str] = WeakKeyDictionary()
        """The credential of each connected task set."""
        self._watcher: asyncio.Task[None] | None = None
        self._server: Server | None = None

    @property
    def port(self) -> int:
        """The port that is listened on."""
        if self._server is not None:
            for socket in self._server.sockets:
                return int(socket.getsockname()[1])
        return self._port

    @property
    def peers(self) -> tuple[Peer, ...]:
        """All task sets that are connected now."""
        return tuple(self._peers.values())

    async def __aenter__(self) -> Self:
        lobby = Lobby("task sets", per_address=UNAUTHENTICATED_PER_ADDRESS)
        connection = guarded(MasterConnection, lobby)
        if self._tls is not None:
            self._gate = TlsGate("control channel", self._tls, lobby)
        self._server = await serve(
            self._serve,
            self._host,
            self._port,
            process_request=self._admit,
            create_connection=behind_gate(connection, self._gate),
            origins=[None],  # pages in browsers must not connect here
            compression=None,
            open_timeout=self._timeouts.open,
            ping_interval=self._timeouts.ping_interval,
            ping_timeout=self._timeouts.ping_timeout,
            close_timeout=self._timeouts.close,
            max_size=MAX_FRAME,
        )
        self._watcher = asyncio.create_task(self._watch_proofs())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # To its end, also if it is cancelled again: what task sets report as they leave needs the master.
        await finish(self._close())

    async def _close(self) -> None:
        assert self._server is not None
        if self._watcher is not None:
            self._watcher.cancel()
        self._server.close(code=_GOING_AWAY, reason="the master is shutting down")
        if self._gate is not None:
            await self._gate.close()
        await self._server.wait_closed()

    async def _watch_proofs(self) -> None:
        """End the connections of task sets whose secret or certificate is accepted no more."""
        while True:
            await asyncio.sleep(PROOF_CHECK_S)
            for socket, shown in list(self._shown.items()):
                if not self._secret.matches(shown):
                    del self._shown[socket]
                    _log.info("the task set at %s must show the new secret", socket.remote_address)
                    await socket.close(_POLICY, "the engine's secret was changed; show the new one")
                elif self._is_revoked is not None and self._is_revoked(_serial_of(socket)):
                    del self._shown[socket]
                    _log.warning(
                        "the task set at %s is dropped: its certificate was revoked", socket.remote_address
                    )
                    await socket.close(_POLICY, "this task set's certificate was revoked")

    async def _admit(self, socket: ServerConnection, request: Request) -> Response | None:
        refusal = self._authenticate(socket, request) or self._refuse_fenced(socket)
        if refusal is None and self._contents is not None and is_for_contents(request.path):
            piece = await answer(request, self._contents)
            return self._refuse_fenced(socket) or piece  # the lead may be lost while it is read
        return refusal

    def _refuse_fenced(self, socket: ServerConnection) -> Response | None:
        if not self._leads_no_more:
            return None
        return socket.respond(HTTPStatus.SERVICE_UNAVAILABLE, "This master leads no more.\n")

    @property
    def _leads_no_more(self) -> bool:
        return self._is_fenced is not None and self._is_fenced()

    def _authenticate(self, socket: ServerConnection, request: Request) -> Response | None:
        given = request.headers.get_all("Authorization")
        scheme, _, token = given[0].partition(" ") if len(given) == 1 else ("", "", "")
        if scheme.lower() == "bearer" and self._secret.matches(token.strip()):
            assert isinstance(socket, GuardedConnection)
            self._shown[socket] = token.strip()
            socket.become_known()
            return None
        _log.warning("a task set at %s came with a wrong secret", socket.remote_address)
        return socket.respond(HTTPStatus.UNAUTHORIZED, "Task sets prove themselves by the engine's secret.\n")

    async def _serve(self, socket: ServerConnection) -> None:
        path = socket.request.path if socket.request is not None else ""
        if path == NODE_STATES_PATH and self._on_node_state is not None:
            await self._on_node_state(socket)
            return
        run = run_of(path)
        if run is not None and self._on_execution is not None:
            await self._on_execution(run, socket)
            return
        if socket.request is not None and socket.request.path == UPLOADS and self._on_upload is not None:
            await self._on_upload(socket)
            return
        try:
            hello = await self._greet(socket)
            if hello is not None:
                await self._serve_peer(Peer(hello, socket, self._timeouts, self._is_fenced), socket)
        except ConnectionClosed as error:
            _log.debug("a task set's connection ended: %s", error)

    async def _greet(self, socket: ServerConnection) -> Hello | None:
        try:
            async with asyncio.timeout(self._timeouts.open):
                message = await self._receive(socket)
        except TimeoutError:
            await socket.close(_POLICY, "no Hello came")
            return None
        if message is None:
            return None
        if not isinstance(message, Hello):
            await socket.close(_POLICY, "the first message must be Hello")
            return None
        if message.version not in ACCEPTED_VERSIONS:
            await self._refuse(
                socket,
                f"control version {message.version} is not one of {', '.join(map(str, ACCEPTED_VERSIONS))}; "
                "upgrade the older one of master and task set",
            )
            return None
        return message

    async def _receive(self, socket: ServerConnection) -> ToMaster | Unknown | None:
        """Take one message; on garbage close the connection and return None."""
        frame = await socket.recv()
        try:
            if isinstance(frame, bytes):
                raise msgspec.DecodeError("a binary frame")
            return decode_to_master(frame)
        except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            _log.warning("garbage from %s: %s", socket.remote_address, error)
            await socket.close(_GARBAGE, _clip(f"garbage: {error}"))
            return None

    async def _refuse(self, socket: ServerConnection, reason: str) -> None:
        _log.warning("refused a task set at %s: %s", socket.remote_address, reason)
        if self._leads_no_more:  # another one may take it at once
            await self._dismiss(socket)
            return
        await socket.send(encode(Refused(reason=reason)))
        await socket.close(_POLICY, _clip(reason))

    async def _dismiss(self, socket: ServerConnection) -> None:
        """Have a task set dial the next master."""
        await socket.close(_GOING_AWAY, "this master leads no more")

    async def _serve_peer(self, peer: Peer, socket: ServerConnection) -> None:
        while (older := self._peers.get(peer.process)) is not None:
            _log.info("%r dialed again", peer)
            older.abort()
            await older.finished.wait()
        self._peers[peer.process] = peer
        try:
            await self._introduce(peer, socket)
        finally:
            peer.leave()
            del self._peers[peer.process]
            peer.finished.set()

    async def _introduce(self, peer: Peer, socket: ServerConnection) -> None:
        welcome = Welcome(
            version=CONTROL_VERSION, master=self._master, features=self._features, term=self._term
        )
        peer.send(welcome)
        try:
            await self._on_hello(peer, peer.hello)
        except PeerRefusedError as error:
            await self._refuse(socket, error.reason)
            return
        except Exception:  # noqa: BLE001 - one peer must not end the server
            if self._leads_no_more:
                await self._dismiss(socket)
                return
            _log.exception("taking %r failed", peer)
            await socket.close(_INTERNAL, "the master failed")
            return
        try:
            await self._converse(peer, socket)
        finally:
            peer.leave()
            await self._on_gone(peer)

    async def _converse(self, peer: Peer, socket: ServerConnection) -> None:
        try:
            async with asyncio.TaskGroup() as tasks:
                writer = tasks.create_task(peer.pump())
                await self._read(peer, socket)
                writer.cancel()
        except* ConnectionClosed as group:
            _log.info("%r left: %s", peer, group.exceptions[0])
        except* Exception:  # noqa: BLE001 - one peer must not end the server
            _log.exception("serving %r failed", peer)
            await socket.close(_INTERNAL, "the master failed")

    async def _read(self, peer: Peer, socket: ServerConnection) -> None:
        while (message := await self._receive(socket)) is not None:
            if self._leads_no_more:
                await self._dismiss(socket)
                return
            match message:
                case LogChunk() | StateSaved():
                    peer.answer(message)
                case Hello():
                    await socket.close(_POLICY, "Hello came twice")
                    return
                case Unknown(name=name):
                    _log.info("%r sent a %s, which this release does not know", peer, name)
                case (
                    Status()
                    | PatchStatus()
                    | SpecWanted()
                    | Gone()
                    | Fault()
                    | Usage()
                    | VolumeRemoved()
                    | VolumeSaved()
                    | VolumeRestored()
                    | Login()
                    | Left()
                    | ClientRequest()
                ):
                    await self._on_message(peer, message)
                case _:
                    assert_never(message)


def _serial_of(socket: ServerConnection) -> int:
    """Return the serial number of a task set's certificate; 0 if it has shown none."""
    shown = socket.transport.get_extra_info("peercert") or {}
    return int(str(shown.get("serialNumber", "0")), 16)


def _clip(reason: str) -> str:
    """Shorten a text to what a close frame can hold."""
    return reason.encode()[:_MAX_REASON].decode(errors="ignore")
