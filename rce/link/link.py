"""One endpoint's end of a link: its channels, over the present carrier."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rce.link.exceptions import ProtocolError
from rce.link.frames import Frame, FrameType

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.control import LinkSpec
    from rce.link.carrier import Carrier
    from rce.link.channel import Channel
    from rce.link.pacing import Pacer
    from rce.link.settings import LinkLimits

_log = logging.getLogger(__name__)


class Link:
    """An endpoint's end of the link to a peer. It outlives its carriers.

    Attributes:
        spec: What the master desires.
        limits: Of everything on this link.
        carrier: What carries the frames at present.
        peer_open: Channels that the peer opened on this carrier; also those that are unknown here yet.
    """

    def __init__(
        self, spec: LinkSpec, limits: LinkLimits, on_growth: Callable[[], None] = lambda: None
    ) -> None:
        self.spec = spec
        self.limits = limits
        self.carrier: Carrier | None = None
        self.peer_open: set[int] = set()
        self._on_growth = on_growth
        self._channels: dict[int, Channel] = {}
        self._pacer: Pacer | None = None
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

    def add(self, channel: Channel) -> None:
        """Add a channel and open it if its interface has started."""
        self._channels[channel.number] = channel
        channel.open()

    def remove(self, channel: Channel) -> None:
        """Close and forget a channel."""
        channel.close()
        del self._channels[channel.number]

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
        if frame.type is FrameType.OPEN:
            if len(self.peer_open) >= self.limits.max_channels:
                raise ProtocolError("too many open channels")
            self.peer_open.add(number)
            if channel is not None:
                channel.peer_opened()
        elif frame.type is FrameType.CLOSE:
            self.peer_open.discard(number)
            if channel is not None:
                channel.peer_closed()
        elif channel is not None:
            channel.frame_received(frame)
        elif frame.type < FrameType.DATA:
            raise ProtocolError(f"{frame.type.name} after the handshake")

    def carrier_lost(self, carrier: Carrier, reason: Exception) -> None:
        """Close all channels."""
        if carrier is self.carrier:
            _log.debug("link %s to %s is down: %s", self.spec.id, self.spec.peer, reason)
            self._lose()

    def _lose(self) -> None:
        self._traffic = self.traffic
        self.carrier = None
        self.peer_open.clear()
        for channel in list(self._channels.values()):
            channel.peer_closed()


def add_traffic(one: tuple[int, int], other: tuple[int, int]) -> tuple[int, int]:
    """Add bytes in and bytes out."""
    return one[0] + other[0], one[1] + other[1]
