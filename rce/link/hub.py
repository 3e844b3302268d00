"""The links of one process: listens, dials, and joins endpoints of the same process."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import socket
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rce.aio.servers import close_servers, open_server
from rce.aio.tasks import BackgroundTasks
from rce.dialing import open_socket
from rce.guard import Guest, Lobby, address_of
from rce.link.carrier import Carrier, LocalCarrier
from rce.link.exceptions import FormerPlaceError, LinkError, LinkLostError, LinkRefusedError
from rce.link.frames import Frame, FrameType, encode
from rce.link.handover import LinkAcceptor
from rce.link.handshake import Hello, check_answer, encode_hello, encode_welcome, parse_hello
from rce.link.opening import secured_link
from rce.link.secure import Adopter, accept_secure, dial_secure
from rce.link.settings import LinkLimits, LinkTimeouts
from rce.link.socket_carrier import SocketCarrier
from rce.link.unix import bind_private, unlink_own

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rce.control import LinkAddress, LinkSpec
    from rce.link.link import Link

_log = logging.getLogger(__name__)

_MAX_EARLY = 4
"""Frames of a dialing end beside its HELLO, which waits for the answer; others would fill the memory."""


class LinkHub:
    """Listens for links, dials them, and joins endpoints of the same process without a socket.

    Args:
        machine: Name of the machine; a peer whose address has the same name is reached by its unix socket.
        timeouts: Of all links.
        limits: Of all links; both ends of a link need the same.
        dial: Connects a stream socket to a peer's address, or raises :class:`OSError`; for a process that
            cannot do that itself, because it has no network for example.
        tls: Refuse to dial peers by TCP without TLS.

    Attributes:
        machine: As given.
        timeouts: As given.
        limits: As given.
        lobby: Accepted connections that have not shown yet which link they are for.
    """

    def __init__(
        self,
        machine: str,
        timeouts: LinkTimeouts | None = None,
        limits: LinkLimits | None = None,
        *,
        dial: Callable[[LinkAddress], Awaitable[socket.socket]] | None = None,
        tls: bool = False,
    ) -> None:
        self._tls = tls
        self._doormen: list[LinkAcceptor] = []
        self.machine = machine
        self.timeouts = timeouts or LinkTimeouts()
        self.limits = limits or LinkLimits()
        self.lobby = Lobby(
            "links", per_address=self.limits.unauthenticated_per_address, in_all=self.limits.unauthenticated
        )
        self._dial = dial
        self._accepting: dict[str, Link] = {}
        self._waiters: dict[str, set[asyncio.Future[None]]] = {}
        self._carriers: set[SocketCarrier] = set()
        self._greetings = BackgroundTasks()
        self._servers: list[asyncio.Server] = []
        self._unix_sockets: dict[Path, int] = {}
        self._closed = False

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        """The running event loop."""
        return asyncio.get_running_loop()

    # Listening

    async def listen_unix(self, path: Path) -> None:
        """Accept links on a unix socket that only this user may use. It is removed by :meth:`close`.

        A socket file that a dead process left behind is replaced.

        Raises:
            OSError: The path is over 107 bytes long or not a socket, or another process listens there.
        """
        sock, inode = bind_private(path)
        await self.listen_socket(sock)
        self._unix_sockets[path] = inode

    async def listen_socket(self, sock: socket.socket) -> None:
        """Accept links on a bound unix socket, which belongs to the hub from now on, also if this raises.

        Raises:
            OSError: The socket cannot be used.
        """
        try:
            sock.setblocking(False)
            server = await self.loop.create_unix_server(self._accept, sock=sock, backlog=512)
        except BaseException:
            sock.close()
            raise
        self._servers.append(server)

    async def listen_tcp(self, host: str, port: int) -> int:
        """Accept links on TCP.

        Args:
            host: Address to bind; empty is every address.
            port: Zero takes a free one.

        Returns:
            The port taken.
        """
        server = await open_server(self._accept, host or None, port, backlog=512)
        self._servers.append(server)
        taken: int = server.sockets[0].getsockname()[1]
        return taken

    async def listen_secure(self, host: str, port: int) -> int:
        """Accept links on TCP, in TLS only. Arguments and result are those of :meth:`listen_tcp`."""
        acceptor = LinkAcceptor(self.timeouts, self.limits, tls=True, everything=Adopter(self.adopt))
        self._doormen.append(acceptor)
        return await acceptor.listen(host, port)

    async def adopt(self, sock: socket.socket, received: bytes) -> None:
        """Take over a connection that was accepted elsewhere, with what was read from it.

        The socket belongs to the hub from now on, also if this raises.

        Raises:
            OSError: The socket cannot be used.
        """
        try:
            sock.setblocking(False)
            if secured := secured_link(received, self.limits):
                await self._adopt_secure(sock, secured)
            else:
                await self.loop.connect_accepted_socket(lambda: self._accept(received), sock)
        except BaseException:
            sock.close()
            raise

    async def close(self) -> None:
        """Stop listening and end every link. No socket and no socket file is left."""
        self._closed = True
        await close_servers(self._servers)
        for path, inode in self._unix_sockets.items():
            unlink_own(path, inode)
        for acceptor in self._doormen:
            await acceptor.close()
        await self._greetings.close()
        for _ in range(2):  # connections that were just being accepted get their carriers, and open
            await asyncio.sleep(0)
        carriers = list(self._carriers)
        for carrier in carriers:
            carrier.abort(LinkLostError("the hub is closed"))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self.timeouts.flush):
                for carrier in carriers:
                    await carrier.wait_closed()
        for server in self._servers:
            await server.wait_closed()
        self._servers.clear()
        self._unix_sockets.clear()

    # Endpoints of this process

    def register(self, link: Link) -> None:
        """Register a link under its id: its peer dials."""
        self._accepting[link.spec.id] = link
        for waiter in self._waiters.get(link.spec.id, ()):
            if not waiter.done():
                waiter.set_result(None)

    def unregister(self, link: Link) -> None:
        """Take :meth:`register` back."""
        if self._accepting.get(link.spec.id) is link:
            del self._accepting[link.spec.id]

    async def wait_registered(self, link_id: str, timeout: float | None) -> None:
        """Wait until a link's accepting end is registered again, or ``timeout`` seconds (None: no limit)."""
        waiter = self.loop.create_future()
        self._waiters.setdefault(link_id, set()).add(waiter)
        try:
            await asyncio.wait([waiter], timeout=timeout)
        finally:
            waiters = self._waiters[link_id]
            waiters.discard(waiter)
            if not waiters:
                del self._waiters[link_id]

    # Dialing

    def can_reach(self, spec: LinkSpec) -> bool:
        """Return whether :meth:`connect` can reach the link; if not, it must be registered here first."""
        if spec.id in self._accepting:
            return True
        address = spec.address
        if self._dial is not None:
            return bool(address.unix or address.port)
        if self._is_near(address):
            return Path(address.unix) not in self._unix_sockets
        return bool(address.port)

    async def connect(self, spec: LinkSpec, *, standby: bool = False) -> Carrier:
        """Reach the accepting end of a link: in this process, by its unix socket, or by TCP.

        Args:
            spec: The link.
            standby: Whether the connection is to stand beside the present one of this end.

        Raises:
            OSError: It cannot be reached, or not in time.
            LinkError: The peer refuses the link, or breaks the protocol.
        """
        local = self._accepting.get(spec.id)
        if local is not None:
            _check(local, spec.token, spec.epoch or None)
            ours, theirs = LocalCarrier.pair()
            local.accept(theirs, standby=standby, copy=spec.copy)
            return ours
        return await self._introduce(await self._reach(spec), spec, standby=standby)

    async def _reach(self, spec: LinkSpec) -> SocketCarrier:
        address = spec.address
        if self._dial is not None:
            return await self._carry(await self._dial(address), spec)
        if self._is_near(address):
            try:
                return await self._dial_unix(spec)
            except OSError as error:
                if not address.port:
                    raise
                _log.debug("link %s: %s does not answer (%s), trying TCP", spec.id, address.unix, error)
        return await self._dial_tcp(spec)

    def _is_near(self, address: LinkAddress) -> bool:
        return bool(address.unix) and address.machine == self.machine

    async def _dial_unix(self, spec: LinkSpec) -> SocketCarrier:
        async with asyncio.timeout(self.timeouts.connect):
            _, carrier = await self.loop.create_unix_connection(self._new_carrier, spec.address.unix)
        return carrier

    async def _dial_tcp(self, spec: LinkSpec) -> SocketCarrier:
        address = spec.address
        async with asyncio.timeout(self.timeouts.connect):
            sock = await open_socket(address.host, address.port)
        return await self._carry(sock, spec)

    async def _carry(self, sock: socket.socket, spec: LinkSpec) -> SocketCarrier:
        """Make a carrier of a connected socket, in TLS if the peer wants that on TCP."""
        try:
            sock.setblocking(False)
            if sock.family == socket.AF_UNIX or not (spec.address.tls or self._tls):
                _, carrier = await self.loop.connect_accepted_socket(self._new_carrier, sock)
            else:
                async with asyncio.timeout(self.timeouts.handshake):
                    carrier = await dial_secure(sock, spec, self._new_carrier)
        except BaseException:
            sock.close()
            raise
        return carrier

    async def _introduce(self, carrier: SocketCarrier, spec: LinkSpec, *, standby: bool) -> Carrier:
        """Shake hands as the dialing end."""
        try:
            epoch = spec.epoch or None
            carrier.greet(encode_hello(spec.id, spec.token, standby=standby, copy=spec.copy, epoch=epoch))
            async with asyncio.timeout(self.timeouts.handshake):
                carrier.features = check_answer(await carrier.handshake_frame())
        except BaseException as error:
            carrier.abort(LinkLostError(f"no handshake: {error}"))
            raise
        return carrier

    # Accepting

    def _new_carrier(self) -> SocketCarrier:
        return SocketCarrier(
            self.limits, self.timeouts, on_open=self._carriers.add, on_closed=self._carriers.discard
        )

    def _accept(
        self, received: bytes = b"", guest: Guest | None = None, until: float | None = None
    ) -> SocketCarrier:
        """Make the carrier of an accepted connection.

        Args:
            received: What was read of it already.
            guest: Its place in the lobby, if it has one already.
            until: When its HELLO must be there, by the loop's clock; None: as :class:`LinkTimeouts` says.
        """
        return SocketCarrier(
            self.limits,
            self.timeouts,
            received=received,
            max_early=_MAX_EARLY,
            on_open=partial(self._admit, former=guest, until=until),
            on_closed=self._carriers.discard,
        )

    def _admit(self, carrier: SocketCarrier, former: Guest | None, until: float | None) -> None:
        """Wait for the HELLO of an accepted connection, if there is room."""
        self._carriers.add(carrier)
        if former is not None:
            former.leave()
        crowded = LinkLostError("too many connections come at once")
        guest = self.lobby.enter(address_of(carrier.peer), lambda: carrier.abort(crowded))
        if self._closed or guest is None:
            carrier.abort(crowded)
        else:
            until = until or self._handshake_end()
            self._greetings.spawn(self._greet(carrier, guest, until), name="link greeting")

    def _handshake_end(self) -> float:
        return self.loop.time() + self.timeouts.handshake

    async def _greet(self, carrier: SocketCarrier, guest: Guest, until: float) -> None:
        """Shake hands as the accepting end."""
        try:
            async with asyncio.timeout_at(until):
                hello = parse_hello(await carrier.handshake_frame())
                link = await self._find(hello)
        except FormerPlaceError as error:
            _log.info("link refused: %s", error)
            self._refuse(carrier, b"the endpoint is somewhere else now")
        except LinkRefusedError as error:
            _log.warning("link refused: %s", error)
            self._refuse(carrier, b"unknown link or wrong token")
        except (LinkError, TimeoutError) as error:
            _log.info("no handshake: %s", str(error) or "it took too long")
            carrier.abort(LinkLostError("no handshake"))
        except BaseException:
            carrier.abort(LinkLostError("the hub is closed"))
            raise
        else:
            carrier.features = frozenset(hello.features)
            carrier.greet(encode_welcome() if hello.features else encode(Frame(FrameType.WELCOME)))
            link.accept(carrier, standby=hello.standby, copy=hello.copy)
        finally:
            guest.leave()

    def _refuse(self, carrier: SocketCarrier, why: bytes) -> None:
        carrier.greet(encode(Frame(FrameType.REFUSE, payload=why)))
        carrier.close()

    async def _adopt_secure(self, sock: socket.socket, link_id: str) -> None:
        """Begin TLS as the accepting end, if there is room; then continue as with any other connection."""
        task = asyncio.current_task()
        assert task is not None
        guest = self.lobby.enter(address_of(sock.getpeername()), task.cancel)
        if guest is None:
            sock.close()
            return
        until = self._handshake_end()  # one limit for TLS and HELLO together
        try:
            async with asyncio.timeout_at(until):
                link = await self._wait_for(link_id)
                await accept_secure(sock, link.spec, partial(self._accept, guest=guest, until=until))
        except (LinkRefusedError, OSError) as error:
            sock.close()
            _log.warning("link refused: no TLS with the peer: %s", str(error) or "it took too long")
        finally:
            guest.leave()

    async def _find(self, hello: Hello) -> Link:
        """Return the link that a peer asks for."""
        link = await self._wait_for(hello.link)
        _check(link, hello.token, hello.epoch)
        return link

    async def _wait_for(self, link_id: str) -> Link:
        """Return a link whose spec may still be on its way."""
        if link_id not in self._accepting:
            await self.wait_registered(link_id, self.timeouts.unknown_link)
        link = self._accepting.get(link_id)
        if link is None:
            raise LinkRefusedError(f"unknown link {link_id!r}")
        return link


def _check(link: Link, token: str, epoch: int | None) -> None:
    """Refuse what is not the peer, and a place that the peer has left, which may not know it yet."""
    if not hmac.compare_digest(link.spec.token.encode(), token.encode()):
        raise LinkRefusedError(f"wrong token for link {link.spec.id!r}")
    if epoch is not None and epoch < link.spec.peer_epoch:
        raise FormerPlaceError(f"link {link.spec.id!r}: {link.spec.peer} is somewhere else now")
