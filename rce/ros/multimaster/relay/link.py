"""A relay over one TCP connection, which either side may make: for robots that cannot be reached."""

from __future__ import annotations

import asyncio
import hmac
import logging
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from rce.dialing import open_socket
from rce.ros.multimaster.errors import LinkBroken
from rce.ros.multimaster.relay.exporter import Exporter
from rce.ros.multimaster.relay.frames import PROTOCOL, Data, Decoder, Frame, Hello, Ping, encode
from rce.ros.multimaster.relay.importer import Importer
from rce.ros.node.queue import DropOldest
from rce.ros.tasks import TaskScope

_log = logging.getLogger(__name__)

DEFAULT_PORT = 11911
PING_PERIOD = 1.0
SILENCE = 3.5
"""Seconds without a frame after which the other side is taken for gone."""

HELLO_TIMEOUT = 5.0
CONNECT_TIMEOUT = 10.0
RETRY_FIRST, RETRY_MOST = 0.2, 5.0
WRITE_HIGH = 2**20
"""Bytes waiting to be sent from which on messages wait, the newest :data:`QUEUE` of them."""

QUEUE = 100
MAX_NEW = 64
"""How many links may wait to be taken."""

MAX_BACKLOG = 16
"""How many frames may come before this side has read the hello."""

MakeEnds = Callable[[Callable[[Frame], None], TaskScope, str], tuple[Exporter, Importer]]
"""Makes both ends for a link, given what takes frames, what owns tasks, and the other side's name."""


@dataclass(frozen=True, slots=True)
class LinkIdentity:
    """What one side says of itself."""

    name: str
    token: str = ""
    """Both sides must have the same."""


class RelayLinks:
    """All links of one synchronization: those it makes and those it takes."""

    def __init__(self, identity: LinkIdentity, make_ends: MakeEnds) -> None:
        self.connected: set[str] = set()
        """Names of the sides that are linked now."""
        self._identity = identity
        self._make_ends = make_ends
        self._running: set[_Link] = set()
        self._guests: asyncio.Queue[_Link] = asyncio.Queue(MAX_NEW)

    async def dial(self, host: str, port: int) -> None:
        """Keep a link to another side, until cancelled."""
        loop = asyncio.get_running_loop()
        wait = RETRY_FIRST
        while True:
            begin = loop.time()
            try:
                async with asyncio.timeout(CONNECT_TIMEOUT):
                    _, link = await loop.create_connection(_Link, sock=await open_socket(host, port))
                await self._serve(link)
            except (OSError, LinkBroken) as error:
                _log.warning("relay to %s:%d: %s", host, port, str(error) or type(error).__name__)
            if loop.time() - begin > RETRY_MOST:  # it did work for a while
                wait = RETRY_FIRST
            await asyncio.sleep(wait * random.uniform(0.5, 1.0))  # noqa: S311 - no secret
            wait = min(RETRY_MOST, 2 * wait)

    async def open_server(self, host: str | None, port: int) -> asyncio.Server:
        """Begin to listen for links; :meth:`serve` takes them.

        Raises:
            OSError: The port cannot be had.
        """
        return await asyncio.get_running_loop().create_server(self._accept, host or "0.0.0.0", port)  # noqa: S104

    async def serve(self, server: asyncio.Server) -> None:
        """Take links of other sides, until cancelled."""
        try:
            async with TaskScope() as tasks:
                while True:
                    link = await self._guests.get()
                    tasks.start(self._serve_guest(link), name="relay link")
        finally:
            server.close()

    def _accept(self) -> _Link:
        link = _Link()
        try:
            self._guests.put_nowait(link)
        except asyncio.QueueFull:
            link.refused = True
        return link

    async def _serve_guest(self, link: _Link) -> None:
        try:
            await self._serve(link)
        except LinkBroken as error:
            _log.warning("relay link: %s", error)

    async def _serve(self, link: _Link) -> None:
        """Run a link until it ends.

        Raises:
            LinkBroken: The other side breaks the protocol, has another token or fell silent.
        """
        try:
            link.send(Hello(self._identity.name, self._identity.token))
            try:
                async with asyncio.timeout(HELLO_TIMEOUT):
                    hello = await link.hello
            except TimeoutError as error:
                raise LinkBroken("the other side does not say who it is") from error
            self._check(hello)
            await self._run(link, hello.name)
        finally:
            link.abort()
            await link.gone.wait()

    def _check(self, hello: Hello) -> None:
        if hello.protocol != PROTOCOL:
            raise LinkBroken(f"{hello.name} speaks protocol {hello.protocol}, not {PROTOCOL}")
        if not hmac.compare_digest(hello.token.encode(), self._identity.token.encode()):
            raise LinkBroken(f"{hello.name} has another token")

    async def _run(self, link: _Link, name: str) -> None:
        _log.info("relay link with %s", name)
        self.connected.add(name)
        self._running.add(link)
        try:
            async with TaskScope() as tasks:
                exporter, importer = self._make_ends(link.send, tasks, name)
                link.start(exporter.take, importer.take)
                tasks.start(exporter.run(), name=f"offer to {name}")
                tasks.start(importer.run(), name=f"take from {name}")
                tasks.start(link.ping(), name=f"ping {name}")
                try:
                    await link.ended
                finally:
                    link.stop()  # a scope that is being left must not be given new tasks
        finally:
            self.connected.discard(name)
            self._running.discard(link)


class _Link(asyncio.Protocol):
    """One connection."""

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        self.hello: asyncio.Future[Hello] = loop.create_future()
        self.ended: asyncio.Future[None] = loop.create_future()
        self.gone = asyncio.Event()
        self._ends: tuple[Callable[[Frame], None], ...] = ()
        self.refused = False
        self._stopped = False
        self._transport: asyncio.Transport | None = None
        self._early: list[Frame] = []
        self._backlog: list[Frame] = []
        self._decoder = Decoder()
        self._waiting: DropOldest[Data] = DropOldest(QUEUE)
        self._full = False
        self._heard = loop.time()

    # ------------------------------------------------------------------ for the owner

    def send(self, frame: Frame) -> None:
        """Send a frame; a message waits, and may be dropped for newer ones, while the connection is full."""
        if isinstance(frame, Data) and self._full:
            self._waiting.put(frame, len(frame.payload))
        elif self._transport is not None and not self._transport.is_closing():
            for piece in encode(frame):
                self._transport.write(piece)
        elif self._transport is None and not self.gone.is_set():
            self._early.append(frame)

    def start(self, *ends: Callable[[Frame], None]) -> None:
        """Give the frames to ``ends`` from now on, those that came since the hello first."""
        self._ends = ends
        backlog, self._backlog = self._backlog, []
        for frame in backlog:
            self._take(frame)

    def stop(self) -> None:
        """Ignore what comes from now on."""
        self._stopped = True

    async def ping(self) -> None:
        """Say now and then that this side is there; end the link when the other does not."""
        loop = asyncio.get_running_loop()
        while True:
            self.send(Ping())
            await asyncio.sleep(PING_PERIOD)
            if loop.time() - self._heard > SILENCE:
                self._fail(LinkBroken("the other side fell silent"))

    def abort(self) -> None:
        """Close now."""
        if self._transport is not None:
            self._transport.abort()
        for future in (self.hello, self.ended):
            future.cancel()

    # ------------------------------------------------------------------ for the transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)  # uvloop's only behave like one
        self._transport.set_write_buffer_limits(high=WRITE_HIGH)
        if self.refused:
            self._transport.abort()
        early, self._early = self._early, []
        for frame in early:
            self.send(frame)

    def data_received(self, data: bytes) -> None:
        self._heard = asyncio.get_running_loop().time()
        try:
            for frame in self._decoder.feed(data):
                self._take(frame)
        except LinkBroken as error:
            self._fail(error)

    def pause_writing(self) -> None:
        self._full = True

    def resume_writing(self) -> None:
        self._full = False
        while self._waiting and not self._full:
            self.send(self._waiting.take())

    def connection_lost(self, error: Exception | None) -> None:
        self._transport = None
        self.gone.set()
        self._fail(LinkBroken(f"the connection is lost: {error or 'the other side closed it'}"))

    def _take(self, frame: Frame) -> None:
        if self._stopped:
            return
        if isinstance(frame, Hello):
            if not self.hello.done():
                self.hello.set_result(frame)
            return
        if not self._ends:
            if not self.hello.done() or len(self._backlog) > MAX_BACKLOG:
                raise LinkBroken("the other side does not begin with a hello")
            self._backlog.append(frame)
        for end in self._ends:
            end(frame)

    def _fail(self, error: LinkBroken) -> None:
        for future in (self.hello, self.ended):
            if not future.done():
                future.set_exception(error)
                future.exception()  # it is not an unseen one: who waits gets it
        if self._transport is not None:
            self._transport.abort()
