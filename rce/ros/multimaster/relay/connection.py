"""One connection of a relay; until the other side has authenticated, it carries few and small frames."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import cast

from rce.aio.queues import BoundedQueue
from rce.guard import Guest, Lobby, address_of
from rce.ros.multimaster.errors import LinkBrokenError, LinkFullError
from rce.ros.multimaster.relay.frames import (
    MAX_FRAME_SIZE,
    MAX_GREETING,
    Answer,
    Call,
    Challenge,
    Data,
    Decoder,
    Frame,
    Greeting,
    Hello,
    Ping,
    Proof,
    Sources,
    encode,
)
from rce.ros.node.settings import MAX_QUEUED_BYTES

PING_PERIOD = 1.0
SILENCE = 3.5
"""Seconds without a frame after which the other side counts as gone."""

WRITE_HIGH = 2**20
"""Bytes waiting to be sent from which on messages wait, the newest :data:`QUEUE` besides the latched ones."""

QUEUE = 100
MAX_WAITING = MAX_QUEUED_BYTES
"""Bytes waiting to be sent beyond which a full connection takes no calls and answers."""

SHORT = 1024
"""Bytes of an answer that a full connection takes nevertheless: such as say why another one was not sent."""

MAX_SHORT = 2**20
"""Bytes that such answers may add; a side that calls on without reading them is left."""

MAX_BACKLOG = 16
"""How many frames may come before this side has read the hello."""

MAX_GREETINGS = 4
"""How many frames of the handshake may wait."""


class RelayConnection(asyncio.Protocol):
    """One connection.

    Args:
        lobby: Where it is counted until it is known; none for one that this side makes.
    """

    def __init__(self, lobby: Lobby | None = None) -> None:
        loop = asyncio.get_running_loop()
        self.address = ""
        self._lobby = lobby
        self._guest: Guest | None = None
        self._greetings: asyncio.Queue[Greeting | None] = asyncio.Queue()
        """The received frames of the handshake; None at the end."""
        self._is_known = False
        self._answered = False
        """Whether the side that was dialed has sent its last frame of the handshake."""
        self.ended: asyncio.Future[None] = loop.create_future()
        self.gone = asyncio.Event()
        self._ends: tuple[Callable[[Frame], None], ...] = ()
        self._refused = False
        self._stopped = False
        self._transport: asyncio.Transport | None = None
        self._early: list[Frame] = []
        self._backlog: list[Frame] = []
        self._decoder = Decoder(MAX_GREETING)
        self._waiting: BoundedQueue[Data | Sources] = BoundedQueue(QUEUE, MAX_QUEUED_BYTES)
        self._full = False
        self._heard = loop.time()

    # For the owner

    def send(self, frame: Frame) -> None:
        """Send a frame; while the connection is full, a message waits, and may be dropped for newer ones.

        A latched message is dropped only for a newer one of its source.

        Raises:
            LinkFullError: A call or an answer does not fit beside what waits to be sent; it was not sent.
        """
        if self._full and isinstance(frame, Data | Sources):
            self._waiting.put(frame, len(frame.payload) if isinstance(frame, Data) else 0, frame.key)
            return
        if self._full and isinstance(frame, Call | Answer) and not self._has_room(frame):
            return
        if self._transport is not None and not self._transport.is_closing():
            for piece in encode(frame):
                self._transport.write(piece)
        elif self._transport is None and not self.gone.is_set():
            self._early.append(frame)

    def _has_room(self, frame: Call | Answer) -> bool:
        """Return whether a full connection takes a call or an answer; one that is too slow for both ends."""
        if self._transport is None:
            return True
        waiting, size = self._transport.get_write_buffer_size(), len(frame.payload)
        if waiting + size <= MAX_WAITING:
            return True
        if isinstance(frame, Call) or size > SHORT:
            raise LinkFullError(waiting, size)
        if waiting + size <= MAX_WAITING + MAX_SHORT:
            return True
        self._fail(LinkBrokenError("the other side does not read the answers to its calls"))
        return False

    async def greeting(self) -> Greeting:
        """Wait for the next frame of the handshake.

        Raises:
            LinkBrokenError: The connection ended, or something else came.
        """
        found = await self._greetings.get()
        if found is None:
            self._greetings.put_nowait(None)
            await self.ended
            raise LinkBrokenError("the connection is lost")
        return found

    def become_known(self) -> None:
        """Take frames of any size from now on: the other side has the token."""
        self._is_known = True
        self._decoder.most = MAX_FRAME_SIZE
        if self._guest is not None:
            self._guest.leave()

    def start(self, *ends: Callable[[Frame], None]) -> None:
        """Pass frames to ``ends`` from now on, beginning with those that came since the hello."""
        self._ends = ends
        backlog, self._backlog = self._backlog, []
        for frame in backlog:
            self._take(frame)

    def stop(self) -> None:
        """Ignore further frames."""
        self._stopped = True

    async def ping(self) -> None:
        """Send a ping periodically; end the link when the other side is silent."""
        loop = asyncio.get_running_loop()
        while True:
            self.send(Ping())
            await asyncio.sleep(PING_PERIOD)
            if loop.time() - self._heard > SILENCE:
                self._fail(LinkBrokenError("the other side fell silent"))

    def end(self, error: LinkBrokenError) -> None:
        """Close now; who waits for the end gets the error."""
        self._fail(error)

    def abort(self) -> None:
        """Close now."""
        if self._transport is not None:
            self._transport.abort()
        self.ended.cancel()

    def refuse(self) -> None:
        """Close now, or as soon as the connection is made."""
        self._refused = True
        self.abort()

    # For the transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Count it, and send what waits."""
        self._transport = cast("asyncio.Transport", transport)  # uvloop's only behave like one
        self._transport.set_write_buffer_limits(high=WRITE_HIGH)
        self.address = address_of(transport.get_extra_info("peername"))
        if self._lobby is not None:
            self._guest = self._lobby.enter(self.address, self._transport.abort)
        if self._refused or (self._lobby is not None and self._guest is None):
            self._transport.abort()
        early, self._early = self._early, []
        for frame in early:
            self.send(frame)

    def data_received(self, data: bytes) -> None:
        """Take frames."""
        self._heard = asyncio.get_running_loop().time()
        try:
            for frame in self._decoder.feed(data):
                self._take(frame)
        except LinkBrokenError as error:
            self._fail(error)

    def pause_writing(self) -> None:
        """Let messages wait."""
        self._full = True

    def resume_writing(self) -> None:
        """Send the messages that wait."""
        self._full = False
        while self._waiting and not self._full:
            self.send(self._waiting.take())

    def connection_lost(self, error: Exception | None) -> None:
        """End."""
        self._transport = None
        if self._guest is not None:
            self._guest.leave()
        self.gone.set()
        self._fail(LinkBrokenError(f"the connection is lost: {error or 'the other side closed it'}"))

    def _take(self, frame: Frame) -> None:
        if self._stopped:
            return
        if isinstance(frame, Hello | Challenge | Proof):
            self._take_greeting(frame)
            return
        if not self._ends:
            if len(self._backlog) > MAX_BACKLOG or not (self._is_known or self._answered):
                raise LinkBrokenError("the other side does not begin with a hello")
            self._backlog.append(frame)
        for end in self._ends:
            end(frame)

    def _take_greeting(self, frame: Greeting) -> None:
        if self._is_known:
            return
        if self._greetings.qsize() >= MAX_GREETINGS:
            raise LinkBrokenError("the other side says too much before the handshake is done")
        if self._lobby is None and isinstance(frame, Hello):
            # The listening side's last frame of the handshake; the next frames may come with it.
            self._answered = True
            self._decoder.most = MAX_FRAME_SIZE
        self._greetings.put_nowait(frame)

    def _fail(self, error: LinkBrokenError) -> None:
        self._greetings.put_nowait(None)
        if not self.ended.done():
            self.ended.set_exception(error)
            self.ended.exception()  # mark the exception as retrieved: waiting callers get it
        if self._transport is not None:
            self._transport.abort()
