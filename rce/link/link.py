"""One endpoint's end of a link: its channels, over the present carrier."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rce.link.exceptions import ProtocolError
from rce.link.frames import Frame, FrameType
from rce.link.handshake import TAKEOVER
from rce.link.pacing import Bucket

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rce.control import LinkSpec
    from rce.link.carrier import Carrier
    from rce.link.channel import Channel
    from rce.link.pacing import Pacer
    from rce.link.settings import LinkLimits

_log = logging.getLogger(__name__)

OPENINGS_AT_ONCE = 8
OPENINGS_PER_S = 1.0
"""How often a peer may open one channel on a connection; it does when its interface was made anew."""


class Link:
    """An endpoint's end of the link to a peer. It outlives its carriers.

    Attributes:
        spec: What the master desires.
        limits: Of everything on this link.
        carrier: What carries the frames at present.
        peer_open: Channels that the peer opened on this carrier; also those that are unknown here yet.
        is_standby: Whether it stands beside the present link to the peer (:mod:`rce.link.takeover`).
        was_left: Whether the peer uses another connection of this link now.
        on_successor: Takes a connection that the peer wants to stand beside the present one.
        on_take: Called when the peer, until then a copy, is the endpoint.
    """

    def __init__(
        self, spec: LinkSpec, limits: LinkLimits, on_growth: Callable[[], None] = lambda: None
    ) -> None:
        self.spec = spec
        self.limits = limits
        self.carrier: Carrier | None = None
        self.peer_open: set[int] = set()
        self.is_standby = False
        self.was_left = False
        self.on_successor: Callable[[Carrier], None] | None = None
        self.on_take: Callable[[], None] = lambda: None
        self._peer_is_copy = False
        """Whether the peer's last connection came from a copy that has not taken over, as far as is known."""
        self._on_growth = on_growth
        self._channels: dict[int, Channel] = {}
        self._pacer: Pacer | None = None
        self._openings: dict[int, Bucket] = {}
        """How often the peer may open each channel again on this carrier."""
        self._traffic = (0, 0)
        """Of former carriers."""

    @property
    def traffic(self) -> tuple[int, int]:
        """Bytes that came in and that went out, with headers."""
        return self._traffic if self.carrier is None else add_traffic(self._traffic, self.carrier.traffic)

    @property
    def unfinished_bytes(self) -> int:
        """Bytes that are set aside for messages that have not come as a whole yet."""
        return 0 if self.carrier is None else self.carrier.unfinished_bytes

    def grew(self) -> None:
        """Take note that :attr:`unfinished_bytes` grew."""
        self._on_growth()

    def drop_unfinished(self, size: int) -> None:
        """Drop the oldest messages that have not come as a whole yet, until ``size`` bytes are free.

        The link continues. Calls that wait for one of them fail; the log and the counters record the others.
        """
        dropped = [] if self.carrier is None else self.carrier.drop_unfinished(size)
        for frame in dropped:
            channel = self._channels.get(frame.channel)
            if channel is not None:
                channel.frame_dropped(frame)

    def pace(self, pacer: Pacer | None) -> None:
        """Limit what passes; none for no limit."""
        self._pacer = pacer
        if self.carrier is not None:
            self.carrier.pace(pacer)

    def __iter__(self) -> Iterator[Channel]:
        return iter(list(self._channels.values()))

    def get(self, number: int) -> Channel | None:
        """Return a channel, or None."""
        return self._channels.get(number)

    def add(self, channel: Channel) -> None:
        """Add a channel and open it if its interface has started."""
        self._channels[channel.number] = channel
        channel.open()

    def remove(self, channel: Channel) -> None:
        """Close and forget a channel."""
        channel.close()
        del self._channels[channel.number]

    def accept(self, carrier: Carrier, *, standby: bool, copy: bool) -> None:
        """Take a carrier that the peer dialed.

        Args:
            carrier: The connection.
            standby: Whether it stands beside the peer's present one: the peer is told at once that this end
                takes over, if it has done so before.
            copy: Whether the peer is a copy: its connection stands beside the present one, or beside none.
        """
        beside_none = self.spec.copy or self._peer_is_copy
        if copy and not beside_none and self.on_successor is not None:
            self.on_successor(carrier)
            return
        self.attach(carrier)
        self._peer_is_copy = copy
        if (standby or copy) and not self.spec.copy:
            self._tell(FrameType.TAKE)

    def change(self, spec: LinkSpec) -> None:
        """Give the link its new spec; if this end belonged to a copy until now, it takes over."""
        takes_over = self.spec.copy and not spec.copy
        self.spec = spec
        if takes_over:
            self._tell(FrameType.TAKE)
            for channel in self:
                channel.slot.send_latched(channel)

    def leave(self) -> None:
        """Tell the peer that another connection of this link is used from now on."""
        self._tell(FrameType.LEAVE)

    def _tell(self, news: FrameType) -> None:
        if self.carrier is not None and TAKEOVER in self.carrier.features:
            self.carrier.control(Frame(news))

    def attach(self, carrier: Carrier) -> None:
        """Continue over a new carrier; a former one is closed, as its peer has given it up."""
        self.detach()
        _log.debug("link %s to %s is up (%s)", self.spec.id, self.spec.peer, carrier.kind)
        self.carrier = carrier
        carrier.pace(self._pacer)
        for channel in list(self._channels.values()):
            channel.open()
        carrier.start(self)

    def detach(self) -> Carrier | None:
        """Close the carrier, if there is one, and return it; all channels are closed at once."""
        carrier = self.carrier
        if carrier is not None:
            carrier.close()
            self._lose()
        return carrier

    def frame_received(self, frame: Frame) -> None:
        """Take a frame of the peer.

        Raises:
            ProtocolError: The peer must not send this.
        """
        number = frame.channel
        channel = self._channels.get(number)
        if frame.type is FrameType.TAKE or frame.type >= FrameType.DATA:
            self._peer_is_copy = False
        if frame.type is FrameType.OPEN:
            if len(self.peer_open) >= self.limits.max_channels:
                raise ProtocolError("too many open channels")
            self.peer_open.add(number)
            if channel is not None:
                self._count_opening(number)
                channel.peer_opened()
        elif frame.type is FrameType.CLOSE:
            self.peer_open.discard(number)
            if channel is not None:
                channel.peer_closed()
        elif frame.type in (FrameType.TAKE, FrameType.LEAVE):
            self._peer_moved(frame.type)
        elif channel is not None:
            channel.frame_received(frame)
        elif frame.type < FrameType.DATA:
            raise ProtocolError(f"{frame.type.name} after the handshake")

    def _count_opening(self, number: int) -> None:
        """Count an OPEN: it brings the peer all latched messages, and costs it 24 bytes.

        Raises:
            ProtocolError: The peer opens the channel again and again.
        """
        now = asyncio.get_running_loop().time()
        openings = self._openings.get(number)
        if openings is None:
            openings = self._openings[number] = Bucket(OPENINGS_PER_S, OPENINGS_AT_ONCE, now)
        if openings.pause(now) > 0:
            raise ProtocolError(f"channel {number} is opened again and again")
        openings.spend(1, now)

    def _peer_moved(self, news: FrameType) -> None:
        if news is FrameType.TAKE:
            self.on_take()
        else:
            self.was_left = True

    def carrier_lost(self, carrier: Carrier, reason: Exception) -> None:
        """Close all channels."""
        if carrier is self.carrier:
            _log.debug("link %s to %s is down: %s", self.spec.id, self.spec.peer, reason)
            self._lose()

    def _lose(self) -> None:
        self._traffic = self.traffic
        self.carrier = None
        self.peer_open.clear()
        self._openings.clear()
        for channel in list(self._channels.values()):
            channel.peer_closed()


def add_traffic(one: tuple[int, int], other: tuple[int, int]) -> tuple[int, int]:
    """Add bytes in and bytes out."""
    return one[0] + other[0], one[1] + other[1]
