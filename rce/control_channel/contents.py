"""Contents by their hash, from the master to task sets: a plain GET on the control port, piece by piece.

``GET /contents/SHA256`` with the secret of the task sets and ``Range: bytes=OFFSET-`` answers 206 with the
next piece and, in ``Content-Range``, the size of the whole. A piece is small enough for a server that has
nothing but the time of a handshake, and a fetch that broke continues where it broke.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from typing import TYPE_CHECKING, NamedTuple, TypeAlias
from urllib.parse import urlsplit

from websockets.datastructures import Headers
from websockets.http11 import Response

from rce.control import ContentError
from rce.control_channel.connections import OpenConnections
from rce.control_channel.timeouts import DEFAULT_TIMEOUTS, ControlTimeouts
from rce.dialing import open_socket
from rce.tls import CertificateError, Context, explain_to_client

if TYPE_CHECKING:
    from websockets.http11 import Request

    from rce.config import Secret
    from rce.control_channel.fetching import Reply
    from rce.masters import Masters

ReadContent: TypeAlias = Callable[[str, int, int], Awaitable[tuple[bytes, int] | None]]
"""Returns a piece (hash, offset, bytes) and the size of the whole; None if the content does not exist."""

PIECE = 512 << 10
"""Bytes."""
_PREFIX = "/contents/"
_DEFAULT_PORT = 80
_PATH = re.compile(rf"{_PREFIX}([0-9a-f]{{64}})")
_FROM = re.compile(r"bytes=([0-9]{1,15})-")
_RANGE = re.compile(r"bytes [0-9]+-[0-9]+/([0-9]{1,15})")
_MISSING = HTTPStatus.NOT_FOUND


def is_for_contents(path: str) -> bool:
    """Return whether a request's path asks for contents."""
    return path.startswith(_PREFIX)


async def answer(request: Request, read: ReadContent) -> Response:
    """Answer a request for a piece. The caller has checked the secret."""
    found = _PATH.fullmatch(request.path)
    start = _FROM.fullmatch(",".join(request.headers.get_all("Range")) or "bytes=0-")
    if found is None or start is None:
        return _refuse(HTTPStatus.BAD_REQUEST, "the path must be /contents/SHA256, the range bytes=OFFSET-")
    offset = int(start[1])
    try:
        piece = await read(found[1], offset, PIECE)
    except OSError as error:
        return _refuse(HTTPStatus.SERVICE_UNAVAILABLE, f"it cannot be read: {error.strerror}")
    if piece is None:
        return _refuse(HTTPStatus.NOT_FOUND, "the master does not have it")
    data, size = piece
    if offset >= size:
        return _refuse(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, f"it has {size} bytes only")
    headers = Headers(
        {
            "Content-Type": "application/octet-stream",
            "Content-Length": str(len(data)),
            "Content-Range": f"bytes {offset}-{offset + len(data) - 1}/{size}",
            "Connection": "close",
        }
    )
    return Response(HTTPStatus.PARTIAL_CONTENT, HTTPStatus.PARTIAL_CONTENT.phrase, headers, data)


def _refuse(status: HTTPStatus, text: str) -> Response:
    body = text.encode()
    headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(body)), "Connection": "close"})
    return Response(status, status.phrase, headers, body)


class Piece(NamedTuple):
    """A part of a content."""

    data: bytes
    size: int
    """Bytes of the whole."""


class ContentClient:
    """Fetches contents from a master.

    Args:
        masters: Where the masters are, as for :class:`rce.control_channel.channel.TaskSetChannel`.
        secret: Proves that this is a task set of the same engine.
        timeouts: Times of this end.
        tls: Gives the TLS context for each connection; none for a plain one.
        connections: Where connections are noted.
    """

    def __init__(
        self,
        masters: Masters,
        secret: Secret,
        timeouts: ControlTimeouts = DEFAULT_TIMEOUTS,
        *,
        tls: Context | None = None,
        connections: OpenConnections | None = None,
    ) -> None:
        self._connections = connections or OpenConnections()
        self._masters = masters
        self._secret = secret
        self._timeouts = timeouts
        self._tls = tls

    async def piece(self, sha256: str, offset: int) -> Piece:
        """Fetch the piece that begins at ``offset``. Cancelling closes the connection.

        Raises:
            ContentError: The master is away or does not have it.
        """
        url = self._masters.current
        try:
            async with asyncio.timeout(self._timeouts.request):
                status, headers, body = await self._get(url, f"{_PREFIX}{sha256}", offset)
        except (OSError, TimeoutError, CertificateError) as error:
            why = explain_to_client(error) or str(error) or "no answer in time"
            raise ContentError(f"the master at {urlsplit(url).netloc} does not hand it out: {why}") from error
        found = _RANGE.fullmatch(headers.get("content-range", ""))
        if status != HTTPStatus.PARTIAL_CONTENT or found is None or not body:
            text = body[:200].decode(errors="replace").strip()
            raise ContentError(
                f"the master does not hand it out: {text or status}", missing=status == _MISSING
            )
        return Piece(body, int(found[1]))

    async def _get(self, url: str, path: str, offset: int) -> Reply:
        from rce.control_channel.fetching import (
            exchange,  # takes 2 MB, which engines without packages do not need
        )

        parts = urlsplit(url)
        host = parts.hostname or ""
        shown = self._secret.reveal()
        tls = None if self._tls is None else self._tls()
        sock = await open_socket(host, parts.port or _DEFAULT_PORT)
        reader, writer = await asyncio.open_connection(
            sock=sock, ssl=tls, server_hostname=None if tls is None else host
        )
        try:
            headers = {"Host": parts.netloc, "Authorization": f"Bearer {shown}", "Range": f"bytes={offset}-"}
            with self._connections.noting(writer.transport, url):
                reply = await exchange(reader, writer, path, headers, PIECE)
            if reply.status == HTTPStatus.UNAUTHORIZED:
                self._secret.was_refused(shown)  # the next attempt shows the other one, if there is one
            return reply
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
