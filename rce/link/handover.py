"""Hand accepted TCP connections over to the process whose endpoint they are for.

One process of a machine accepts links for all its containers. It reads the HELLO of each connection, which
names the link, and passes the socket with those bytes to the container's process, over a unix socket with
``SCM_RIGHTS``. From then on data goes straight to that process::

    peer --TCP--> LinkAcceptor --(socket, HELLO)--> HandoverSender =unix=> HandoverReceiver --> LinkHub.adopt

The unix socket must keep message boundaries (``SOCK_SEQPACKET`` or ``SOCK_DGRAM``).
"""

from __future__ import annotations

import array
import asyncio
import contextlib
import logging
import os
import socket
from functools import partial
from typing import TYPE_CHECKING

from rce.aio.tasks import BackgroundTasks
from rce.guard import Lobby, address_of
from rce.link.exceptions import LinkError, LinkRefusedError
from rce.link.frames import HANDSHAKE_SIZE, HEADER_SIZE, Frame, FrameType, encode
from rce.link.opening import LinkSender, PlainLinkRefusedError, read_hello
from rce.link.settings import LinkLimits, LinkTimeouts

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

_log = logging.getLogger(__name__)

_BUSY_PAUSE = 0.1
"""Seconds to wait after the system refused to accept, for example because file descriptors ran out."""
_BACKLOG = 512
"""Connections that the system keeps until they are accepted."""
_FD = array.array("i")


class HandoverSender:
    """Passes connections to one process.

    Args:
        sock: Connected to a :class:`HandoverReceiver`; belongs to the sender from now on.
    """

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._sock = sock
        self._turn = asyncio.Lock()

    async def send(self, connection: socket.socket, received: bytes) -> None:
        """Pass a connection and what was read from it; the caller closes its own copy afterwards.

        Raises:
            OSError: The process is gone.
        """
        rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [connection.fileno()]))]
        async with self._turn:
            while True:
                try:
                    self._sock.sendmsg([received], rights)
                except BlockingIOError:
                    await self._writable()
                else:
                    return

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()

    async def _writable(self) -> None:
        loop = asyncio.get_running_loop()
        ready = loop.create_future()
        loop.add_writer(self._sock, _resolve, ready)
        try:
            await ready
        finally:
            loop.remove_writer(self._sock)


class HandoverReceiver:
    """Takes connections from a :class:`HandoverSender`.

    Args:
        sock: Connected to the sender; belongs to the receiver from now on.
        adopt: What to do with a connection, as :meth:`rce.link.hub.LinkHub.adopt`.
        on_end: Called when the sender is gone.
    """

    def __init__(
        self,
        sock: socket.socket,
        adopt: Callable[[socket.socket, bytes], Awaitable[None]],
        *,
        on_end: Callable[[], None] | None = None,
    ) -> None:
        sock.setblocking(False)
        self._sock = sock
        self._adopt = adopt
        self._on_end = on_end
        self._scope = BackgroundTasks()
        self._begun: set[socket.socket] = set()
        """Connections whose task has not run yet; it may be cancelled before."""
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(sock, self._read)
        self._open = True

    async def close(self) -> None:
        """Stop taking connections."""
        self._stop()
        await self._scope.close()
        for connection in self._begun:
            connection.close()
        self._begun.clear()

    def _stop(self) -> None:
        if self._open:
            self._open = False
            self._loop.remove_reader(self._sock)
            self._sock.close()

    def _read(self) -> None:
        """Take every waiting connection."""
        while self._open:
            try:
                received, descriptors = _receive(self._sock)
            except BlockingIOError:
                return
            except OSError as error:
                _log.debug("handover ended: %s", error)
                received, descriptors = b"", []
            if not received:
                self._stop()
                if self._on_end is not None:
                    self._on_end()
            for descriptor in descriptors:
                try:
                    connection = socket.socket(fileno=descriptor)
                except OSError as error:
                    _log.info("what was handed over is not a connection: %s", error)
                    os.close(descriptor)
                    continue
                self._begun.add(connection)
                self._scope.spawn(self._take(connection, received), name="handed-over connection")

    async def _take(self, connection: socket.socket, received: bytes) -> None:
        self._begun.discard(connection)
        try:
            await self._adopt(connection, received)
        except (OSError, ValueError) as error:
            _log.info("a handed-over connection is of no use: %s", error)


def _resolve(ready: asyncio.Future[None]) -> None:
    if not ready.done():
        ready.set_result(None)


def _receive(sock: socket.socket) -> tuple[bytes, list[int]]:
    """Read a message and the descriptors that came with it."""
    size = HEADER_SIZE + HANDSHAKE_SIZE
    received, ancillary, _, _ = sock.recvmsg(
        size, socket.CMSG_SPACE(_FD.itemsize), getattr(socket, "MSG_CMSG_CLOEXEC", 0)
    )
    descriptors = array.array("i")
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            descriptors.frombytes(data[: len(data) - len(data) % _FD.itemsize])
    for descriptor in descriptors:
        os.set_inheritable(descriptor, False)
    return received, list(descriptors)


class LinkAcceptor:
    """Accepts TCP links for the endpoints of other processes and hands each to the right one.

    Args:
        timeouts: Of links.
        limits: Of links.
        tls: Refuse links without TLS.
        everything: Takes the links that are not assigned to a sender; if None, they are refused.

    Attributes:
        lobby: Accepted connections that have not been handed over yet.
    """

    def __init__(
        self,
        timeouts: LinkTimeouts | None = None,
        limits: LinkLimits | None = None,
        *,
        tls: bool = False,
        everything: LinkSender | None = None,
    ) -> None:
        self._tls = tls
        self._everything = everything
        self._timeouts = timeouts or LinkTimeouts()
        self._limits = limits or LinkLimits()
        self.lobby = Lobby(
            "links to hand over",
            per_address=self._limits.unauthenticated_per_address,
            in_all=self._limits.unauthenticated,
        )
        self._routes: dict[str, HandoverSender] = {}
        self._assigned = asyncio.Condition()
        self._sockets: list[socket.socket] = []
        self._pauses: dict[socket.socket, asyncio.TimerHandle] = {}
        self._scope = BackgroundTasks()

    async def listen(self, host: str, port: int) -> int:
        """Accept links.

        Args:
            host: Address to bind.
            port: Zero takes a free one.

        Returns:
            The port taken.
        """
        sock = socket.create_server((host, port), backlog=_BACKLOG)
        sock.setblocking(False)
        self._sockets.append(sock)
        self._begin_accepting(sock)
        taken: int = sock.getsockname()[1]
        return taken

    async def assign(self, sender: HandoverSender, links: Iterable[str]) -> None:
        """Send the links with these ids, and no others, to ``sender`` from now on."""
        self._forget(sender)
        async with self._assigned:
            self._routes.update(dict.fromkeys(links, sender))
            self._assigned.notify_all()

    async def reassign(self, sender: HandoverSender, added: Iterable[str], removed: Iterable[str]) -> None:
        """Send some more links to ``sender``, and some no longer."""
        for link in removed:
            if self._routes.get(link) is sender:
                del self._routes[link]
        async with self._assigned:
            self._routes.update(dict.fromkeys(added, sender))
            self._assigned.notify_all()

    def forget(self, sender: HandoverSender) -> None:
        """Send no more links to ``sender``."""
        self._forget(sender)

    async def close(self) -> None:
        """Stop accepting; connections that were not handed over are closed."""
        for pause in self._pauses.values():
            pause.cancel()
        self._pauses.clear()
        for sock in self._sockets:
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()
        self._sockets.clear()
        await self._scope.close()

    def _forget(self, sender: HandoverSender) -> None:
        for link in [link for link, target in self._routes.items() if target is sender]:
            del self._routes[link]

    def _accept(self, sock: socket.socket) -> None:
        """Accept the connections that wait; called by the event loop.

        ``loop.sock_accept`` would lose a connection if it were cancelled just after it accepted.
        """
        loop = asyncio.get_running_loop()
        for _ in range(_BACKLOG):
            try:
                connection, peer = sock.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError as error:
                _log.warning("cannot accept a link: %s", error)
                loop.remove_reader(sock)
                self._pauses[sock] = loop.call_later(_BUSY_PAUSE, self._begin_accepting, sock)
                return
            connection.setblocking(False)
            task = self._scope.spawn(self._receive(connection, address_of(peer)), name="link to hand over")
            task.add_done_callback(partial(_close, connection))  # also if it is cancelled before it begins

    def _begin_accepting(self, sock: socket.socket) -> None:
        self._pauses.pop(sock, None)
        asyncio.get_running_loop().add_reader(sock, self._accept, sock)

    async def _receive(self, connection: socket.socket, address: str) -> None:
        """Pass a connection on, if there is room for it; one that must make room is cancelled."""
        task = asyncio.current_task()
        assert task is not None
        guest = self.lobby.enter(address, task.cancel)
        if guest is not None:
            try:
                await self._pass_on(connection)
            finally:
                guest.leave()

    async def _pass_on(self, connection: socket.socket) -> None:
        try:
            async with asyncio.timeout(self._timeouts.handshake):
                received = await read_hello(connection, self._limits)
                if self._tls and not received.secure:
                    raise PlainLinkRefusedError(received.link)
                sender = await self._find(received.link)
                await sender.send(connection, received.data)
        except LinkRefusedError as error:
            _log.warning("link refused: %s", error)
            why = (
                error.for_peer if isinstance(error, PlainLinkRefusedError) else b"unknown link or wrong token"
            )
            with contextlib.suppress(OSError):
                connection.send(encode(Frame(FrameType.REFUSE, payload=why)))
        except (LinkError, OSError) as error:
            _log.info("a link was not handed over: %s", str(error) or type(error).__name__)

    async def _find(self, link: str) -> LinkSender:
        """Return the sender of a link; its assignment may still be on its way."""
        if self._everything is not None:
            return self._everything
        try:
            async with asyncio.timeout(self._timeouts.unknown_link), self._assigned:
                await self._assigned.wait_for(lambda: link in self._routes)
                return self._routes[link]
        except TimeoutError as error:
            raise LinkRefusedError(f"unknown link {link!r}") from error


def _close(sock: socket.socket, _: asyncio.Task[None]) -> None:
    sock.close()
