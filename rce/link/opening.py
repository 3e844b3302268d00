"""The first frame of an accepted connection: which link it is for, and whether TLS follows."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Protocol

from rce.link.exceptions import LinkLostError, LinkRefusedError, ProtocolError
from rce.link.frame_reader import FrameReader
from rce.link.frames import HANDSHAKE_SIZE, HEADER_SIZE, FrameType
from rce.link.handshake import parse_opening

if TYPE_CHECKING:
    import socket

    from rce.link.settings import LinkLimits


class LinkSender(Protocol):
    """Takes accepted connections."""

    async def send(self, connection: socket.socket, received: bytes) -> None:
        """Pass a connection and what was read from it; the caller closes its own copy afterwards.

        Raises:
            OSError: The connection is refused.
        """


class PlainLinkRefusedError(LinkRefusedError):
    """A peer dialed without TLS, and TLS is required."""

    for_peer = b"links are taken in TLS only here; start the peer's program with --tls too"

    def __init__(self, link: str) -> None:
        super().__init__(f"link {link!r} came without TLS")


class ReceivedHello:
    """The first frame of a connection.

    Attributes:
        link: Id of the link that the peer asks for.
        secure: Whether TLS follows.
        data: The bytes that were read.
    """

    def __init__(self, link: str, secure: bool, data: bytes) -> None:
        self.link = link
        self.secure = secure
        self.data = data


async def read_hello(connection: socket.socket, limits: LinkLimits) -> ReceivedHello:
    """Read the first frame of a connection and not a byte more.

    Raises:
        ProtocolError: It begins no link.
        LinkLostError: The connection ended.
        OSError: The connection failed.
    """
    loop = asyncio.get_running_loop()
    connection.setblocking(False)
    reader = FrameReader(limits, max_message=HANDSHAKE_SIZE)
    data = bytearray()
    missing = HEADER_SIZE
    while True:
        part = await loop.sock_recv(connection, missing)
        if not part:
            raise LinkLostError("the peer hung up")
        data += part
        frames = reader.feed(part)
        if frames:
            return ReceivedHello(*parse_opening(frames[0]), bytes(data))
        missing = reader.missing
        if len(data) + missing > HEADER_SIZE + HANDSHAKE_SIZE:
            raise ProtocolError("HELLO is too long")


def secured_link(received: bytes, limits: LinkLimits) -> str:
    """Return the link for which TLS follows; empty if this is not an announcement of TLS.

    Args:
        received: What was read of a connection.
        limits: Of links.

    Raises:
        ProtocolError: It begins no link.
    """
    if received[:1] != bytes([FrameType.SECURE]):
        return ""
    frames = FrameReader(limits, max_message=HANDSHAKE_SIZE).feed(received)
    return parse_opening(frames[0])[0] if frames else ""
