"""One HTTP request of a task set to its master, with h11 for the framing."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import h11

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Mapping

_CHUNK = 1 << 16


class Reply(NamedTuple):
    """The answer to a request."""

    status: int
    headers: dict[str, str]
    """By their names in lower case."""
    body: bytes


async def exchange(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
    path: str,
    headers: Mapping[str, str],
    max_body: int,
) -> Reply:
    """Send a GET and read its answer. Cancelling leaves the connection unusable.

    Args:
        reader: Of the connection.
        writer: Of the connection.
        path: What to get.
        headers: Of the request.
        max_body: Maximum number of bytes of the answer's body.

    Raises:
        OSError: The connection broke, or what came is not an answer, or is too long.
    """
    connection = h11.Connection(h11.CLIENT)
    try:
        writer.write(
            connection.send(h11.Request(method="GET", target=path, headers=list(headers.items()))) or b""
        )
        return await _response(connection, reader, max_body)
    except h11.RemoteProtocolError as error:
        raise ConnectionError(str(error)) from error


async def _response(connection: h11.Connection, reader: asyncio.StreamReader, max_body: int) -> Reply:
    status, headers, body = 0, dict[str, str](), bytearray()
    while True:
        event = connection.next_event()
        match event:
            case h11.Response():
                status = event.status_code
                headers = {name.decode(): value.decode("latin-1") for name, value in event.headers}
            case h11.Data():
                body += event.data
                if len(body) > max_body:
                    raise h11.RemoteProtocolError("a piece is too long")
            case h11.EndOfMessage():
                return Reply(status, headers, bytes(body))
            case h11.NEED_DATA:
                connection.receive_data(await reader.read(_CHUNK))
            case _:
                raise h11.RemoteProtocolError("the connection was closed")
