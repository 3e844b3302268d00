"""The first step of a client: ask the master over HTTP where its robot endpoint is.

One small request per connection does not justify an HTTP client's start-up time on a robot, so this is
``h11`` (sans-I/O) on an asyncio stream: cancellable at any point, TLS by the stream.
"""

from __future__ import annotations

import asyncio
import json
from http import HTTPStatus
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import urlencode, urlsplit

import h11

from rce.dialing import open_socket
from rce_client.exceptions import RefusedError, UnavailableError, UntrustedError
from rce_client.failures import judge, judge_status

if TYPE_CHECKING:
    import ssl

VERSION = "20130902"
"""Version of the client protocol, a date."""

_MAX_BODY = 65536
_PORTS = {"http": 80, "https": 443}


class Endpoint(NamedTuple):
    """The endpoint that a robot connects to."""

    url: str
    """WebSocket URL."""
    takes_header: bool
    """Whether the credential may go in the header ``Authorization``."""


async def locate(
    url: str,
    user: str,
    *,
    version: str = VERSION,
    tls: ssl.SSLContext | None = None,
    timeout: float = 10.0,
    connect: float | None = None,
) -> Endpoint:
    """Ask the master at ``url`` for a robot endpoint.

    Args:
        url: The master, ``http://HOST:PORT/`` or ``https://``.
        user: User ID.
        version: Protocol version that this client speaks.
        tls: TLS settings for ``https``; the system's if None.
        timeout: Seconds for the whole exchange.
        connect: Seconds of them for the TCP connection; None: all.

    Raises:
        RefusedError: The master refuses this client, or the URL is not valid.
        UntrustedError: The master's certificate is not trusted, or a URL with ``https`` leads to an endpoint
            without TLS.
        UnavailableError: The master cannot be reached now.
    """
    parts = urlsplit(url)
    try:
        port = parts.port or _PORTS[parts.scheme]
    except (KeyError, ValueError) as error:
        raise RefusedError(0, f"{url!r} is not an http or https URL") from error
    if not parts.hostname:
        raise RefusedError(0, f"{url!r} has no host")
    target = f"{parts.path or '/'}?{urlencode({'userID': user, 'version': version, 'auth': 'bearer'})}"
    try:
        async with asyncio.timeout(timeout):
            is_https = parts.scheme == "https"
            async with asyncio.timeout(connect):
                sock = await open_socket(parts.hostname, port)
            reader, writer = await asyncio.open_connection(
                sock=sock,
                ssl=(tls or True) if is_https else None,
                server_hostname=parts.hostname if is_https else None,
            )
            try:
                status, body = await _get(reader, writer, parts.netloc.rpartition("@")[2], target)
            finally:
                writer.close()
    except (OSError, EOFError, h11.ProtocolError) as error:
        if isinstance(error, h11.ProtocolError):
            raise UnavailableError(f"{url} does not speak HTTP: {error}") from error
        raise judge(error) from error
    found = _read_answer(url, status, body)
    if parts.scheme == "https" and urlsplit(found.url).scheme != "wss":
        raise UntrustedError(
            f"the master at {url} sends robots to {found.url}, which is not encrypted and would show this"
            " robot's credential; run rce-robot with --tls, or behind a proxy with"
            " --public-url wss://...",
        )
    return found


async def _get(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, host: str, target: str
) -> tuple[int, bytes]:
    """Send one GET request.

    Returns:
        Status and body.
    """
    connection = h11.Connection(h11.CLIENT)
    headers = [("Host", host), ("Accept", "application/json"), ("Connection", "close")]
    writer.write(connection.send(h11.Request(method="GET", target=target, headers=headers)) or b"")
    writer.write(connection.send(h11.EndOfMessage()) or b"")
    status = 0
    body = bytearray()
    while True:
        event = connection.next_event()
        if event is h11.NEED_DATA:
            connection.receive_data(await reader.read(65536))
        elif isinstance(event, h11.Response):
            status = event.status_code
        elif isinstance(event, h11.Data):
            body += event.data
            if len(body) > _MAX_BODY:
                raise UnavailableError("the master's answer is too long")
        elif isinstance(event, (h11.EndOfMessage, h11.ConnectionClosed)):
            return status, bytes(body)


def _read_answer(url: str, status: int, body: bytes) -> Endpoint:
    """Return the endpoint in the master's answer, or raise what the answer means."""
    text = body.decode(errors="replace").strip()
    if status != HTTPStatus.OK:
        raise judge_status(status, text or f"{url} answered {status}")
    try:
        answer = json.loads(text)
        found = answer["url"]
    except (ValueError, KeyError, TypeError) as error:
        raise UnavailableError(f"{url} did not answer as a master does; is it the master's URL?") from error
    if not isinstance(found, str) or urlsplit(found).scheme not in ("ws", "wss"):
        raise UnavailableError(f"the master answered with {found!r}, which is not a WebSocket URL")
    return Endpoint(found, answer.get("auth") == "bearer")
