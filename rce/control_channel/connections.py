"""A task set's open connections to masters beside the control channel."""

from __future__ import annotations

import contextlib
import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Iterator

_log = logging.getLogger(__name__)


class OpenConnections:
    """Connections that end when their master is silent on the control channel, or another one leads.

    A master that hangs, or whose machine was cut off, does not end them itself. What waits for its answers
    would wait much longer than it takes to find the next leader, and can be asked for again there.
    """

    def __init__(self) -> None:
        self._urls: dict[asyncio.WriteTransport, str] = {}

    @contextlib.contextmanager
    def noting(self, transport: asyncio.WriteTransport, url: str) -> Iterator[None]:
        """Note a connection to the master at an address, as long as the block runs."""
        self._urls[transport] = url
        try:
            yield
        finally:
            del self._urls[transport]

    def note_silent(self, url: str) -> None:
        """Abort the connections to a master that is silent on the control channel."""
        self._abort([one for one, to in self._urls.items() if to == url])

    def note_leader(self, url: str) -> None:
        """Abort the connections to all masters but the one that leads now."""
        self._abort([one for one, to in self._urls.items() if to != url])

    @staticmethod
    def _abort(transports: list[asyncio.WriteTransport]) -> None:
        for transport in transports:
            transport.abort()
        if transports:
            _log.info("ended %d connections to a master that is silent, or leads no more", len(transports))
