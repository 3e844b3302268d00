"""The XML-RPC client: one per process or node, keep-alive connections to every server it has called."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence
from functools import partial
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

import h11

from rce.aio.tasks import BackgroundTasks
from rce.dialing import set_keepalive
from rce.ros.dialing import open_peer_socket
from rce.ros.errors import (
    MalformedDocumentError,
    RemoteFaultError,
    RpcRefusedError,
    RpcTimeoutError,
    RpcUnreachableError,
    XmlRpcError,
)
from rce.ros.xmlrpc.batches import METHOD, join_calls, raise_error, split_answer
from rce.ros.xmlrpc.client_connection import ClientConnection
from rce.ros.xmlrpc.codec import decode_response, encode_call
from rce.ros.xmlrpc.requests import RequestQueue, RpcRequest

_log = logging.getLogger(__name__)

MAX_CONNECTIONS = 4
"""How many connections there are to one server. More calls at once wait for their turn."""

IDLE_TIME = 30.0
"""Seconds that an idle connection is kept."""

DEFAULT_TIMEOUT = 10.0

Address = tuple[str, int]

_LOST = (ConnectionError, EOFError, h11.RemoteProtocolError)
"""A connection that was kept may end so, because its server closed it."""


class RpcClient:
    """Calls XML-RPC servers. An async context manager; leaving it closes the connections.

    Any number of calls may run at once. Those to one server share a few connections, so that a program which
    registers thousands of topics at once takes neither the memory nor the sockets of its server. Calls that
    wait go together in one request (:mod:`rce.ros.xmlrpc.batches`) to servers that say that they are
    :class:`~rce.ros.xmlrpc.server.RpcServer`, and one by one to all others.

    A connection is kept for the next call until the server ends it, or for :data:`IDLE_TIME`: nodes come and
    go, each with ports of its own.
    """

    def __init__(self) -> None:
        self._servers: dict[Address, _Server] = {}
        self._open: set[ClientConnection] = set()
        self._tasks = BackgroundTasks()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._tasks.close()
        for server in list(self._servers.values()):
            _fail(server.requests.give_up(), RpcUnreachableError, "the client is closed")
            for connection in list(server.idle):
                self._end_idleness(connection)
        for connection in list(self._open):
            await self._discard(connection)

    @property
    def connections(self) -> int:
        """How many connections it has now, idle ones among them."""
        return len(self._open)

    def takes_batches(self, uri: str) -> bool:
        """Return whether the server at ``uri`` is known to take several calls in one request."""
        try:
            server = self._servers.get(_address(uri))
        except ValueError:
            return False
        return server is not None and any(connection.takes_batches for connection in server.idle)

    async def call(
        self, uri: str, method: str, arguments: Sequence[Any], *, timeout: float = DEFAULT_TIMEOUT
    ) -> Any:
        """Call ``method`` of the server at ``uri``.

        Cancelling a call closes its connection, unless other calls wait for the same answer.

        Args:
            uri: ``http://host:port/``.
            method: The method's name.
            arguments: Values that XML-RPC can carry.
            timeout: Seconds that the server may take. Those are not counted in which the call waits behind
                others that the server answers.

        Raises:
            RpcUnreachableError: No answer came, for whatever reason; an RpcTimeoutError if none came in time,
                an RpcRefusedError if the connection was refused.
            RemoteFaultError: The server answered with a fault.
            MalformedDocumentError: An argument cannot be sent or the answer cannot be read.
        """
        return await self.send(uri, method, encode_call(method, arguments), timeout=timeout)

    async def send(self, uri: str, method: str, document: bytes, *, timeout: float = DEFAULT_TIMEOUT) -> Any:
        """Make a call from an encoded document, as :meth:`call` does.

        Args:
            uri: ``http://host:port/``.
            method: The method's name, for errors.
            document: The call, by :func:`~rce.ros.xmlrpc.codec.encode_call`.
            timeout: As for :meth:`call`.

        Raises:
            RpcUnreachableError: No answer came, for whatever reason; an RpcTimeoutError if none came in time,
                an RpcRefusedError if the connection was refused.
            RemoteFaultError: The server answered with a fault.
            MalformedDocumentError: The answer cannot be read.
        """
        (answer,) = await self.send_in_order(uri, method, (document,), timeout=timeout)
        return raise_error(answer)

    async def send_in_order(
        self, uri: str, method: str, documents: Sequence[bytes], *, timeout: float = DEFAULT_TIMEOUT
    ) -> list[Any]:
        """Make calls one after the other, or in one request if the server takes that.

        Args:
            uri: ``http://host:port/``.
            method: The first call's method, for errors.
            documents: The calls, by :func:`~rce.ros.xmlrpc.codec.encode_call`.
            timeout: Seconds that the server may take for each request, as for :meth:`call`.

        Returns:
            For each call its value, or a RemoteFaultError or MalformedDocumentError.

        Raises:
            RpcUnreachableError: Not all calls were answered; those that were are not known.
        """
        try:
            address = _address(uri)
        except ValueError as error:
            raise RpcUnreachableError(uri, str(error)) from error
        if self._tasks.closed:
            raise RpcUnreachableError(uri, "the client is closed")
        server = self._servers.get(address)
        if server is None:
            server = self._servers[address] = _Server(address)
        request = RpcRequest(uri, documents, timeout, is_alone=method == METHOD)
        server.requests.add(request)
        self._begin(server)
        try:
            return await server.requests.wait(request)
        except TimeoutError as error:
            raise RpcTimeoutError(uri, f"{method} took longer than {timeout:g} s") from error
        finally:
            server.requests.drop(request)

    async def until_lost(self, uri: str) -> None:
        """Wait until the server at ``uri`` goes away: until a connection made for nothing else is lost.

        Raises:
            RpcUnreachableError: It is away already.
        """
        try:
            reader, writer = await asyncio.open_connection(sock=await open_peer_socket(*_address(uri)))
        except (OSError, ValueError) as error:
            raise RpcUnreachableError(uri, str(error)) from error
        set_keepalive(writer.get_extra_info("socket"), idle=10, interval=5, count=4)  # half a minute
        try:
            with contextlib.suppress(OSError):  # lost, whatever the reason
                await reader.read(1)
        finally:
            writer.transport.abort()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    # Requests whose turn it is

    def _begin(self, server: _Server) -> None:
        """Take requests from a queue, as many as there may be connections."""
        while server.requests and server.busy < MAX_CONNECTIONS and not self._tasks.closed:
            connection = self._take_idle(server)
            group = server.requests.take(together=connection is not None and connection.takes_batches)
            server.busy += 1
            work = self._tasks.spawn(
                self._perform(server, group, connection), name=f"calls of {group[0].uri}"
            )
            work.add_done_callback(partial(self._end, server, group))
            for request in group:
                request.work = work
        self._forget_unused(server)

    def _end(self, server: _Server, group: list[RpcRequest], work: asyncio.Task[None]) -> None:
        """Continue with other requests when those of a group are done with."""
        if work.cancelled():  # the callers have gone, or the client is closed
            _fail(group, RpcUnreachableError, "the client is closed")
        elif (error := work.exception()) is not None:  # an unexpected one, which is reported too
            _fail(group, RpcUnreachableError, repr(error), error)
        server.busy -= 1
        self._begin(server)

    async def _perform(
        self, server: _Server, group: list[RpcRequest], connection: ClientConnection | None
    ) -> None:
        """Make the calls of some requests."""
        try:
            await self._make_calls(server, group, connection)
        except ConnectionRefusedError as error:
            _fail(group, RpcRefusedError, str(error), error)
        except (OSError, h11.ProtocolError, EOFError, ValueError) as error:
            _fail(group, RpcUnreachableError, str(error) or type(error).__name__, error)

    async def _make_calls(
        self, server: _Server, group: list[RpcRequest], connection: ClientConnection | None
    ) -> None:
        documents = [document for request in group for document in request.documents]
        answers: list[Any] = []
        together = True
        was_used = connection is not None
        while rest := documents[len(answers) :]:
            if connection is None:
                connection, was_used = await self._connect(server), False
            try:
                if together and len(rest) > 1 and connection.takes_batches:
                    answered = await _post_together(connection, rest)
                    together = bool(answered)
                    answers += answered
                else:
                    answers.append(_decoded(await connection.post(rest[0])))
            except BaseException as error:
                await self._discard(connection)
                if not was_used or not isinstance(error, _LOST):
                    raise
                # The server closed the idle connection, as it may at any time. ROS calls may be repeated.
                _log.debug("reconnecting to %s: %s", group[0].uri, error)
                connection = self._take_idle(server)
                continue
            was_used = True
            server.requests.answered(group)
            if not connection.reusable:
                await self._discard(connection)
                connection = None
        for request in group:
            count = len(request.documents)
            request.finish(answers[:count])
            del answers[:count]
        if connection is not None:
            await self._give_back(server, connection)

    async def _connect(self, server: _Server) -> ClientConnection:
        connection = await ClientConnection.open(*server.address, on_eof=self._drop_idle, on_lost=self._lost)
        self._open.add(connection)
        return connection

    # Connections

    async def _give_back(self, server: _Server, connection: ClientConnection) -> None:
        if self._tasks.closed or not connection.reusable:
            await self._discard(connection)
            return
        server.idle.append(connection)
        connection.idle_end = asyncio.get_running_loop().call_later(IDLE_TIME, self._drop_idle, connection)

    def _take_idle(self, server: _Server) -> ClientConnection | None:
        if not server.idle:
            return None
        connection = server.idle.pop()
        _stop_idle_timer(connection)
        return connection

    def _end_idleness(self, connection: ClientConnection) -> bool:
        """Remove a connection from the idle ones; return whether it was one of them."""
        server = self._servers.get(connection.address)
        if server is None or connection not in server.idle:
            return False
        server.idle.remove(connection)
        _stop_idle_timer(connection)
        self._forget_unused(server)
        return True

    def _drop_idle(self, connection: ClientConnection) -> None:
        """Close a connection, if it is idle: its server has ended it, or its time is over."""
        if self._end_idleness(connection):
            connection.abort()

    def _lost(self, connection: ClientConnection) -> None:
        self._end_idleness(connection)
        self._open.discard(connection)

    async def _discard(self, connection: ClientConnection) -> None:
        self._open.discard(connection)
        await connection.close()

    def _forget_unused(self, server: _Server) -> None:
        if not server.requests and not server.busy and not server.idle:
            self._servers.pop(server.address, None)


class _Server:
    """What a client knows of one server: it is forgotten with its last connection."""

    def __init__(self, address: Address) -> None:
        self.address = address
        self.requests = RequestQueue()
        self.busy = 0
        """How many connections are used, or are being made."""
        self.idle: list[ClientConnection] = []


def _stop_idle_timer(connection: ClientConnection) -> None:
    if connection.idle_end is not None:
        connection.idle_end.cancel()
        connection.idle_end = None


async def _post_together(connection: ClientConnection, documents: list[bytes]) -> list[Any]:
    """Make several calls in one request; return nothing if one of them keeps all from being answered."""
    try:
        return split_answer(await connection.post(join_calls(documents)), len(documents))
    except XmlRpcError as error:
        _log.debug("%d calls are repeated one by one: %s", len(documents), error)
        return []


def _decoded(answer: bytes) -> Any:
    """Return the value that a document answers, or the error."""
    try:
        return decode_response(answer)
    except (RemoteFaultError, MalformedDocumentError) as error:
        return error


def _fail(
    group: list[RpcRequest],
    error: type[RpcUnreachableError],
    reason: str,
    cause: BaseException | None = None,
) -> None:
    for request in group:
        request.fail(error(request.uri, reason), cause)


def _address(uri: str) -> Address:
    parts = urlsplit(uri)
    if parts.scheme != "http" or not parts.hostname or not parts.port:
        raise ValueError("not a URI of the form http://host:port/")
    return parts.hostname, parts.port
