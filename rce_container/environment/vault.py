"""The container's way to the snapshots of its nodes' states: the manager keeps and fetches them for it.

The bytes of a snapshot travel on a socket of their own that the manager sends, so that control messages never
wait behind them.
"""

from __future__ import annotations

import asyncio
import socket
from itertools import count
from typing import TYPE_CHECKING, TypeVar

from rce.control import NODE_STATES
from rce_container.environment.exceptions import NodeStateError
from rce_container.environment.messages import StateOffered, StateWanted

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection

_TIMEOUT_S = 60.0
"""Seconds that the manager may take for an answer."""
_CHUNK = 1 << 18

T = TypeVar("T")


class _Request:
    """A request that waits for the manager's answers."""

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        self.socket: asyncio.Future[socket.socket | None] = loop.create_future()
        """Carries the snapshot; None: there is none."""
        self.done: asyncio.Future[None] = loop.create_future()

    def fail(self, text: str) -> None:
        """Fail everything that is waited for."""
        for future in (self.socket, self.done):
            if not future.done():
                future.set_exception(NodeStateError(text))
                future.exception()  # only one of both is waited for


class ManagerVault:
    """Asks the manager to fetch and keep snapshots.

    Implements :class:`rce_container.environment.nodes.states.Vault`.

    Args:
        send: Sends a message to the manager; returns whether one is connected.
    """

    def __init__(self, send: Callable[[StateWanted | StateOffered], bool]) -> None:
        self._send = send
        self._knows_states = False
        self._numbers = count(1)
        self._requests: dict[int, _Request] = {}

    def begin(self) -> None:
        """Start over with another manager, which knows no earlier requests."""
        self._knows_states = False
        for request in self._requests.values():
            request.fail("the container's manager was started again meanwhile")

    def learn(self, features: Collection[str]) -> None:
        """Note the manager's features."""
        self._knows_states = NODE_STATES in features

    async def fetch(self, node: str) -> bytes | None:
        """Return the newest snapshot of a node; None if there is none.

        Raises:
            NodeStateError: It cannot be told now.
        """
        number = next(self._numbers)
        request = self._ask(number, StateWanted(request=number, node=node))
        try:
            sock = await _in_time(request.socket)
            return None if sock is None else await _in_time(_read(sock))
        finally:
            self._forget(number)

    async def keep(self, node: str, state: bytes) -> None:
        """Keep a snapshot; when this returns, it is acknowledged.

        Raises:
            NodeStateError: It is not kept, or that is not known.
        """
        number = next(self._numbers)
        request = self._ask(number, StateOffered(request=number, node=node, size=len(state)))
        try:
            if (sock := await _in_time(request.socket)) is not None:
                await _in_time(_write(sock, state))
            await _in_time(request.done)
        finally:
            self._forget(number)

    def opened(self, number: int, sock: socket.socket | None) -> None:
        """Take the socket that carries a snapshot; None: there is no snapshot."""
        request = self._requests.get(number)
        if request is not None and not request.socket.done():
            request.socket.set_result(sock)
        elif sock is not None:
            sock.close()

    def answered(self, number: int, error: str) -> None:
        """Handle the manager's last answer to a request."""
        request = self._requests.get(number)
        if request is None:
            return
        if error:
            request.fail(error)
        elif not request.done.done():
            request.done.set_result(None)

    def _ask(self, number: int, message: StateWanted | StateOffered) -> _Request:
        if not self._knows_states:
            raise NodeStateError("the container's manager is away, or of an earlier release")
        request = self._requests[number] = _Request()
        if not self._send(message):
            del self._requests[number]
            raise NodeStateError("the container's manager is away")
        return request

    def _forget(self, number: int) -> None:
        request = self._requests.pop(number)
        if request.socket.done() and not request.socket.cancelled() and not request.socket.exception():
            sock = request.socket.result()
            if sock is not None:
                sock.close()


async def _in_time(work: Awaitable[T]) -> T:
    try:
        async with asyncio.timeout(_TIMEOUT_S):
            return await work
    except TimeoutError:
        raise NodeStateError(f"no answer within {_TIMEOUT_S:.0f} s") from None
    except OSError as error:
        raise NodeStateError(f"the container's manager went away: {error}") from error


async def _read(sock: socket.socket) -> bytes:
    """Read a snapshot: its size in eight bytes, then the snapshot."""
    loop = asyncio.get_running_loop()
    sock.setblocking(False)
    data = bytearray()
    while piece := await loop.sock_recv(sock, _CHUNK):
        data += piece
    size = int.from_bytes(data[:8], "big")
    if len(data) != 8 + size:
        raise NodeStateError("it came in part only")
    del data[:8]
    return bytes(data)


async def _write(sock: socket.socket, state: bytes) -> None:
    sock.setblocking(False)
    await asyncio.get_running_loop().sock_sendall(sock, state)
    sock.shutdown(socket.SHUT_WR)
