"""Sends answers to clients that may take nothing: each write ends in time, and few bytes wait in all.

A client that reads nothing would otherwise keep its connection, and all of its answer, for good.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from aiohttp import web

_log = logging.getLogger(__name__)

WRITE_S = 60.0
"""A client that takes no more for so long is cut off: each piece of a stream has so long, and an answer so
long more than it takes at :data:`LEAST_RATE`."""
LEAST_RATE = 1 << 16
"""Bytes a second."""
PIECE = 1 << 16
"""Bytes of a stream that are written at once."""
MAX_UNREAD = 256 << 20
"""Bytes of whole answers that clients of one server have yet to take. Beyond it, the client that has had its
answer for longest is cut off."""


async def write(request: web.Request, response: web.StreamResponse, data: bytes) -> None:
    """Send a part of a stream.

    Args:
        request: The request, whose connection is aborted if the client takes nothing.
        response: The prepared answer.
        data: The part.

    Raises:
        ConnectionError: The client is gone, or took nothing for :data:`WRITE_S`.
    """
    for first in range(0, len(data), PIECE):
        await write_in_time(request, response.write(data[first : first + PIECE]))


async def write_in_time(request: web.Request, writing: Awaitable[object], limit: float | None = None) -> None:
    """Wait until something is written.

    Args:
        request: The request, whose connection is aborted if the client takes nothing.
        writing: Writes it.
        limit: Seconds that it may take; None: :data:`WRITE_S`.

    Raises:
        ConnectionError: The client is gone, or takes nothing.
    """
    try:
        async with asyncio.timeout(WRITE_S if limit is None else limit):
            await writing
    except TimeoutError:
        abort(request)
        raise ConnectionResetError("the client takes nothing") from None


def abort(request: web.Request) -> None:
    """Cut a client off at once."""
    if request.transport is not None:
        request.transport.abort()


class UnreadAnswers:
    """The whole answers of a server that its clients have yet to take."""

    def __init__(self) -> None:
        self._waiting: dict[web.Response, tuple[web.Request, int]] = {}
        """Their requests and sizes; oldest first."""

    async def send(self, request: web.Request, response: web.Response) -> None:
        """Send a whole answer; return when the client has taken nearly all of it, or is gone."""
        body = response.body
        size = len(body) if isinstance(body, bytes | bytearray) else 0
        self._waiting[response] = request, size
        self._make_room()
        try:
            await write_in_time(request, _send(request, response), WRITE_S + size / LEAST_RATE)
        except ConnectionError as error:
            _log.debug("an answer of %d bytes was not taken by %s: %s", size, request.remote, error)
        finally:
            self._waiting.pop(response, None)

    def _make_room(self) -> None:
        """Cut off the clients that had their answers first, until few bytes wait."""
        left = sum(size for _, size in self._waiting.values())
        for response, (request, size) in list(self._waiting.items())[:-1]:
            if left <= MAX_UNREAD:
                return
            _log.warning("%s is cut off: it takes too little of an answer of %d bytes", request.remote, size)
            del self._waiting[response]
            left -= size
            abort(request)


async def _send(request: web.Request, response: web.Response) -> None:
    await response.prepare(request)
    await response.write_eof()
