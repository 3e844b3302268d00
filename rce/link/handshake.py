"""The handshake of a link: HELLO, its answer, and the features of each end (sans-I/O)."""

from __future__ import annotations

import msgspec

from rce.link.exceptions import LinkRefusedError, ProtocolError
from rce.link.frames import VERSION, Frame, FrameType, encode


class Hello(msgspec.Struct, frozen=True, kw_only=True):
    """Payload of HELLO."""

    version: int
    link: str
    token: str
    features: tuple[str, ...] = ()
    """The dialing end's features beyond the first version; unknown words are ignored."""
    standby: bool = False
    """Whether this connection is to stand beside the dialing end's present one until TAKE
    (:mod:`rce.link.takeover`)."""
    copy: bool = False
    """Whether the dialing end is a copy: the connection is to stand beside the accepting end's present one,
    also if that one is down."""
    epoch: int | None = None
    """Of the dialing end's place; None if it does not know that of its endpoint, as releases before."""


class Welcome(msgspec.Struct, frozen=True, kw_only=True):
    """Payload of WELCOME; empty from a peer that knows the first version only."""

    features: tuple[str, ...] = ()


LATCH = "latch"
"""Feature: latched messages name their source, and SOURCES takes back those of sources that ended."""
TAKEOVER = "takeover"
"""Feature: a second connection of a link may stand by and take over."""
FEATURES = (LATCH, TAKEOVER)
"""This end's features beyond the first version of links."""

_hello_decoder = msgspec.json.Decoder(Hello)
_welcome_decoder = msgspec.json.Decoder(Welcome)


def encode_hello(
    link: str, token: str, *, standby: bool = False, copy: bool = False, epoch: int | None = None
) -> bytes:
    """Write the first frame of a link's dialing end."""
    hello = Hello(
        version=VERSION,
        link=link,
        token=token,
        features=FEATURES,
        standby=standby,
        copy=copy,
        epoch=epoch,
    )
    return encode(Frame(FrameType.HELLO, payload=msgspec.json.encode(hello)))


def encode_welcome() -> bytes:
    """Write the accepting end's answer to HELLO."""
    return encode(Frame(FrameType.WELCOME, payload=msgspec.json.encode(Welcome(features=FEATURES))))


def parse_hello(frame: Frame) -> Hello:
    """Read the first frame of a link's dialing end.

    Raises:
        ProtocolError: It is not a HELLO, or one of a version that is not spoken here.
    """
    if frame.type is not FrameType.HELLO:
        raise ProtocolError(f"first frame is {frame.type.name}, not HELLO")
    try:
        hello = _hello_decoder.decode(frame.payload)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ProtocolError(f"bad HELLO: {error}") from error
    if hello.version != VERSION:
        raise ProtocolError(f"link version {hello.version} is not spoken here, {VERSION} is")
    return hello


def encode_secure(link: str) -> bytes:
    """Write the frame that announces TLS for a link."""
    return encode(Frame(FrameType.SECURE, payload=link.encode()))


def parse_opening(frame: Frame) -> tuple[str, bool]:
    """Read the first frame of a link's dialing end.

    Returns:
        The link, and whether TLS follows.

    Raises:
        ProtocolError: The frame does not begin a link.
    """
    if frame.type is not FrameType.SECURE:
        return parse_hello(frame).link, False
    try:
        return bytes(frame.payload).decode(), True
    except UnicodeDecodeError as error:
        raise ProtocolError(f"bad SECURE: {error}") from error


def check_answer(frame: Frame) -> frozenset[str]:
    """Read the accepting end's answer to HELLO.

    Returns:
        The features that the peer knows.

    Raises:
        LinkRefusedError: The peer refuses the link.
        ProtocolError: The frame is not an answer to HELLO.
    """
    if frame.type is FrameType.REFUSE:
        raise LinkRefusedError(bytes(frame.payload).decode(errors="replace"))
    if frame.type is not FrameType.WELCOME:
        raise ProtocolError(f"HELLO was answered by {frame.type.name}")
    if not frame.payload:
        return frozenset()
    try:
        return frozenset(_welcome_decoder.decode(frame.payload).features)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ProtocolError(f"bad WELCOME: {error}") from error
