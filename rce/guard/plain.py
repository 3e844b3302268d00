"""Tell TLS clients that a port does not speak TLS, in words that their TLS library passes on as a fault."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rce.guard.lobby import address_of
from rce.guard.rates import LogThrottle

if TYPE_CHECKING:
    import asyncio

_log = logging.getLogger(__name__)

_HANDSHAKE_RECORD = 0x16
"""First byte that a TLS client sends; an HTTP request never begins with it."""
_TEXT = b"This port does not speak TLS: use http:// or ws://\n"
_ANSWER = (
    b"HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain\r\nConnection: close\r\n"
    b"Content-Length: %d\r\n\r\n%b" % (len(_TEXT), _TEXT)
)


class PlainPort:
    """Refuses TLS clients of a server without TLS.

    Args:
        name: The service on the port, for the log.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._throttle = LogThrottle()

    def refuses(self, transport: asyncio.Transport, data: bytes, now: float) -> bool:
        """Return whether a connection is refused for its first bytes; if so, it is answered and closed.

        Args:
            transport: Of the connection.
            data: Its first bytes.
            now: Seconds that never go back.
        """
        if data[:1] != bytes([_HANDSHAKE_RECORD]):
            return False
        address = address_of(transport.get_extra_info("peername"))
        if self._throttle.is_due(address, now):
            _log.warning(
                "%s: a client at %s was not taken: it speaks TLS at a port without TLS; let it use http:// or"
                " ws://, or start this program with --tls",
                self._name,
                address or "this machine",
            )
        transport.write(_ANSWER)
        transport.close()
        return True
