"""A relay over one TCP connection, which either side may make: for robots that cannot be reached."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from rce.aio.backoff import Backoff
from rce.aio.servers import close_servers, open_server
from rce.aio.tasks import TaskScope, errors_in
from rce.dialing import open_socket
from rce.guard import Lobby, LogThrottle
from rce.ros.errors import RosError
from rce.ros.multimaster.errors import LinkBrokenError, MultimasterError, SecondLinkError
from rce.ros.multimaster.relay.connection import RelayConnection
from rce.ros.multimaster.relay.exporter import Exporter
from rce.ros.multimaster.relay.frames import Frame
from rce.ros.multimaster.relay.handshake import DialerHandshake, ListenerHandshake
from rce.ros.multimaster.relay.importer import Importer
from rce.ros.node.settings import is_loopback

_log = logging.getLogger(__name__)

DEFAULT_PORT = 11911
HELLO_TIMEOUT = 5.0
CONNECT_TIMEOUT = 10.0
RETRY = Backoff(first=0.2, longest=5.0, jitter=0.5)
WORKED_AFTER = 5.0
"""After a link that lasted for so many seconds, the next pause is short again."""
MAX_NEW = UNAUTHENTICATED = 64
"""How many links may wait to be taken, or have not shown yet that they have the token."""

UNAUTHENTICATED_PER_ADDRESS = 16
"""The same from one address."""


MakeEnds = Callable[[Callable[[Frame], None], TaskScope, str], tuple[Exporter, Importer]]
"""Makes both ends of a link, from the receiver of frames, the owner of tasks, and the other side's name."""


@dataclass(frozen=True, slots=True)
class LinkIdentity:
    """The identity of one side."""

    name: str
    token: str = ""
    """Both sides must have the same."""


def check_listening(host: str, token: str) -> None:
    """Refuse to listen for other machines without a token.

    Args:
        host: Address to listen on; empty for all.
        token: What other sides must have.

    Raises:
        MultimasterError: Other machines could connect, and no token is set that they must have.
    """
    if not token and not is_loopback(host):
        raise MultimasterError(
            f"relay connections on {host or 'all addresses'} need a token: give --relay-token"
            " (or RCE_RELAY_TOKEN) at both ends, or listen on this machine only with --relay-addr 127.0.0.1"
        )


def broken_by(failure: Exception) -> LinkBrokenError:
    """Turn the failure of an end, or a group of them, into the error that ends this link, and no other."""
    error = next(errors_in(failure)) if isinstance(failure, ExceptionGroup) else failure
    if isinstance(error, LinkBrokenError):
        return error
    if not isinstance(error, RosError | OSError):
        _log.error("an end of a relay failed", exc_info=failure)
    return LinkBrokenError(str(error) or type(error).__name__)


@dataclass(frozen=True, slots=True)
class _OtherSide:
    """The other side of a link: its name, and whether this side has dialed it."""

    name: str
    is_dialed: bool


class RelayLinks:
    """All links of one synchronization: dialed and accepted ones."""

    def __init__(self, identity: LinkIdentity, make_ends: MakeEnds) -> None:
        self._identity = identity
        self._make_ends = make_ends
        self._running: dict[RelayConnection, _OtherSide] = {}
        """The links and their other sides: a side that dials again may have two for a while."""
        self._next_end = asyncio.Event()
        """Set, and replaced by a new one, when a link has ended."""
        self._guests: asyncio.Queue[RelayConnection] = asyncio.Queue(MAX_NEW)
        self._lobby = Lobby("relay links", per_address=UNAUTHENTICATED_PER_ADDRESS, in_all=UNAUTHENTICATED)
        self._throttle = LogThrottle()
        self._dialing: set[str] = set()
        """Nonces of the attempts to dial that are not over."""

    @property
    def connected(self) -> set[str]:
        """Names of the sides that are linked now."""
        return {other.name for other in self._running.values()}

    async def dial(self, host: str, port: int) -> None:
        """Keep a link to another side, until cancelled."""
        loop = asyncio.get_running_loop()
        pauses = RETRY.start()
        while True:
            begin = loop.time()
            try:
                async with asyncio.timeout(CONNECT_TIMEOUT):
                    sock = await open_socket(host, port)
                    _, link = await loop.create_connection(RelayConnection, sock=sock)
                await self._serve(link, self._greet_as_dialer, is_dialed=True)
            except SecondLinkError as error:
                _log.info("relay to %s:%d: %s", host, port, error)
                await self._until_unlinked(error.name)
            except (OSError, LinkBrokenError) as error:
                _log.warning("relay to %s:%d: %s", host, port, str(error) or type(error).__name__)
            if loop.time() - begin > WORKED_AFTER:
                pauses.reset()
            await asyncio.sleep(pauses.next())

    async def open_server(self, host: str | None, port: int) -> asyncio.Server:
        """Begin to listen for links; :meth:`serve` takes them.

        Raises:
            MultimasterError: Other machines could connect, and no token is set that they must have.
            OSError: The port cannot be bound.
        """
        check_listening(host or "", self._identity.token)
        every = "0.0.0.0"  # noqa: S104
        return await open_server(self._accept, host or every, port, backlog=100)

    async def serve(self, server: asyncio.Server) -> None:
        """Take links of other sides, until cancelled."""
        try:
            async with TaskScope() as tasks:
                while True:
                    link = await self._guests.get()
                    tasks.spawn(self._serve_guest(link), name="relay link")
        finally:
            await close_servers([server])
            while not self._guests.empty():
                self._guests.get_nowait().refuse()

    def _accept(self) -> RelayConnection:
        link = RelayConnection(self._lobby)
        try:
            self._guests.put_nowait(link)
        except asyncio.QueueFull:
            link.refuse()
        return link

    async def _serve_guest(self, link: RelayConnection) -> None:
        try:
            await self._serve(link, self._greet_as_listener, is_dialed=False)
        except SecondLinkError as error:
            _log.info("relay link from %s: %s", link.address, error)
        except LinkBrokenError as error:
            if self._throttle.is_due(link.address, asyncio.get_running_loop().time()):
                _log.warning("relay link from %s: %s", link.address, error)

    async def _serve(
        self, link: RelayConnection, greet: Callable[[RelayConnection], Awaitable[str]], *, is_dialed: bool
    ) -> None:
        """Run a link until it ends.

        Raises:
            SecondLinkError: Both sides have dialed each other, and the other link is kept.
            LinkBrokenError: The other side breaks the protocol, has another token or fell silent.
        """
        try:
            try:
                async with asyncio.timeout(HELLO_TIMEOUT):
                    name = await greet(link)
            except TimeoutError as error:
                raise LinkBrokenError("the other side does not say who it is") from error
            except (ValueError, TypeError, ArithmeticError, LookupError) as error:
                raise LinkBrokenError(f"a handshake that cannot be understood: {error}") from error
            link.become_known()
            other = _OtherSide(name, is_dialed)
            await self._be_the_only_one(other)
            await self._run(link, other)
        finally:
            link.abort()
            await link.gone.wait()

    async def _greet_as_dialer(self, link: RelayConnection) -> str:
        """Shake hands; return the other side's name."""
        handshake = DialerHandshake(self._identity.name, self._identity.token)
        self._dialing.add(handshake.nonce)
        try:
            link.send(handshake.begin())
            link.send(handshake.prove(await link.greeting()))
            try:
                last = await link.greeting()
            except LinkBrokenError as error:
                raise LinkBrokenError(f"{error}; it may have another token") from error
            return handshake.finish(last)
        finally:
            self._dialing.discard(handshake.nonce)

    async def _greet_as_listener(self, link: RelayConnection) -> str:
        """Shake hands; return the other side's name."""
        identity = self._identity
        handshake = ListenerHandshake(identity.name, identity.token, frozenset(self._dialing))
        link.send(handshake.challenge(await link.greeting()))
        name, hello = handshake.finish(await link.greeting())
        link.send(hello)
        return name

    async def _be_the_only_one(self, other: _OtherSide) -> None:
        """End the link that the other side has made, or this one: over two, each message comes twice.

        Both sides keep the one that the side with the smaller name has dialed. Several sides of one name are
        not told apart: none of the links that one side accepted ends.

        Raises:
            SecondLinkError: The other link is kept.
        """
        own, name = self._identity.name, other.name
        if own == name:
            return
        error = SecondLinkError(name)
        for link in self._made_otherwise(other):
            if other.is_dialed != (own < name):
                raise error
            link.end(error)
        while self._made_otherwise(other):
            await self._next_end.wait()

    def _made_otherwise(self, other: _OtherSide) -> list[RelayConnection]:
        twin = _OtherSide(other.name, not other.is_dialed)
        return [link for link, side in self._running.items() if side == twin]

    async def _until_unlinked(self, name: str) -> None:
        """Wait until no link with a side runs."""
        while name in self.connected:
            await self._next_end.wait()

    async def _run(self, link: RelayConnection, other: _OtherSide) -> None:
        name = other.name
        _log.info("relay link with %s", name)
        self._running[link] = other
        try:
            async with TaskScope() as tasks:
                exporter, importer = self._make_ends(link.send, tasks, name)
                link.start(exporter.take, importer.take)
                tasks.spawn(exporter.run(), name=f"offer to {name}")
                tasks.spawn(importer.run(), name=f"take from {name}")
                tasks.spawn(link.ping(), name=f"ping {name}")
                try:
                    await link.ended
                finally:
                    link.stop()  # a scope that is being left must not be given new tasks
        except ExceptionGroup as group:
            raise broken_by(group) from group
        finally:
            del self._running[link]
            self._next_end.set()
            self._next_end = asyncio.Event()
