"""The frames of a link: a fixed header and an untouched payload (sans-I/O).

Every frame starts with 24 bytes in network order::

    offset  size  field
         0     1  type     FrameType
         1     1  flags    LATCHED, OVERLOADED
         2     2  zero
         4     4  id       of a service call, or of a latched message's source; 0 elsewhere
         8     8  channel  0 for frames of the link itself
        16     4  length   bytes of payload in this frame
        20     4  total    bytes of payload in the whole message

A message with ``total`` above ``length`` continues in FRAGMENT frames of the same channel. A channel has at
most one unfinished message at a time; frames of other channels, and frames that carry a whole message, may
come in between. ABORT says that the rest of the channel's unfinished message will not come.

Since the first frame tells the total, the reader allocates the message once and has the socket read straight
into it.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

from rce.link.exceptions import ProtocolError
from rce.link.settings import KIB

if TYPE_CHECKING:
    from collections.abc import Collection


VERSION = 1
HEADER = struct.Struct("!BBHIQII")
HEADER_SIZE = HEADER.size
FRAGMENT_SIZE = 128 * KIB
"""Most bytes of payload that a sender puts in one frame: an urgent frame waits for it 1 ms at 1 Gbit/s."""
HANDSHAKE_SIZE = 4 * KIB
"""Most bytes of payload before the peer has authenticated."""
LATCHED = 1
"""Flag of DATA: the topic's last message, kept for peers that connect later."""
OVERLOADED = 2
"""Flag of FAULT: the peer has too many requests already."""
MAX_CHANNEL = 2**64 - 1
MAX_ID = 2**32 - 1


class FrameType(IntEnum):
    """The type of a frame."""

    HELLO = 1
    """Dialing end's first frame: names the link and has its token."""
    WELCOME = 2
    """Accepting end's answer; the link is up."""
    REFUSE = 3
    """Accepting end's refusal, with the reason as text; it closes the connection."""
    PING = 4
    PONG = 5
    SECURE = 7
    """Dialing end's first frame on TCP, where the peer's address wants TLS: the link; TLS begins after it."""
    GRANT = 6
    """How far the peer may send bulk: an offset of 8 bytes in the stream (:mod:`rce.link.flow_control`)."""
    OPEN = 8
    """The sender's interface is ready on this channel."""
    CLOSE = 9
    """The sender's interface is gone from this channel."""
    TAKE = 10
    """The sender, until now the copy of an endpoint, is the endpoint from here on."""
    LEAVE = 11
    """The sender uses another connection of this link from here on, to the endpoint at its new place."""
    DATA = 16
    """A message of a topic."""
    CALL = 17
    """A request; the answer has the same id."""
    REPLY = 18
    FAULT = 19
    """A text in place of a REPLY."""
    CANCEL = 20
    """The caller does not wait for the answer to the CALL with this id any more."""
    SOURCES = 21
    """Ids of the sources whose latched messages are in force, 4 bytes each; only to peers with ``latch``."""
    FRAGMENT = 24
    ABORT = 25


class Frame(NamedTuple):
    """A whole message, or a frame without payload."""

    type: FrameType
    channel: int = 0
    id: int = 0
    flags: int = 0
    payload: bytes | memoryview = b""


def pack_header(frame: Frame, length: int, total: int) -> bytes:
    """Write the header of a frame that carries the first ``length`` of ``total`` bytes of a message."""
    return HEADER.pack(frame.type, frame.flags, 0, frame.id, frame.channel, length, total)


def pack_fragment(channel: int, length: int, total: int) -> bytes:
    """Write the header of a frame that carries the next ``length`` bytes of the channel's message."""
    return HEADER.pack(FrameType.FRAGMENT, 0, 0, 0, channel, length, total)


def encode(frame: Frame) -> bytes:
    """Write a frame with its whole payload."""
    size = len(frame.payload)
    return pack_header(frame, size, size) + frame.payload


def encode_sources(channel: int, sources: Collection[int]) -> Frame:
    """Make the frame that tells which sources' latched messages are in force."""
    return Frame(FrameType.SOURCES, channel, payload=struct.pack(f"!{len(sources)}I", *sources))


def parse_sources(payload: bytes) -> frozenset[int]:
    """Read :func:`encode_sources`.

    Raises:
        ProtocolError: The frame is not a valid SOURCES frame.
    """
    if len(payload) % 4:
        raise ProtocolError(f"SOURCES of {len(payload)} bytes")
    return frozenset(struct.unpack(f"!{len(payload) // 4}I", payload))
