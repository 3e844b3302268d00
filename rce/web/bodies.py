"""Reads the bodies of requests, which may come slowly, damaged or not at all."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

BODY_S = 30.0
"""How long a body, or a piece of one that is streamed, may take."""
_CHUNK = 1 << 16
_DAMAGED = (ConnectionError, HttpProcessingError, web.RequestPayloadError, web.PayloadAccessError)


async def read_whole(request: web.Request) -> bytes:
    """Read a body at once.

    Raises:
        HTTPBadRequest: It is damaged, or the client is gone.
        HTTPRequestTimeout: It did not come in good time.
        HTTPRequestEntityTooLarge: It is larger than the application's limit.
    """
    with _faults():
        async with asyncio.timeout(BODY_S):
            return await request.read()


async def read_pieces(request: web.Request) -> AsyncIterator[bytes]:
    """Read a body piece by piece.

    Raises:
        HTTPBadRequest: It is damaged, or the client is gone.
        HTTPRequestTimeout: A piece did not come in good time.
    """
    while True:
        with _faults():
            async with asyncio.timeout(BODY_S):
                chunk = await request.content.read(_CHUNK)
        if not chunk:
            return
        yield chunk


@contextlib.contextmanager
def _faults() -> Iterator[None]:
    try:
        yield
    except TimeoutError:
        raise web.HTTPRequestTimeout from None
    except _DAMAGED:
        raise web.HTTPBadRequest(reason="the body is damaged, or did not come whole") from None
