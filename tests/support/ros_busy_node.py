"""The API of a node that does not answer its first call."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from rce.ros.xmlrpc.codec import encode_response


@asynccontextmanager
async def answering_second_call(calls: asyncio.Queue[bytes], *, loses: bool) -> AsyncIterator[str]:
    """Serve the API of such a node; give its URI.

    Args:
        calls: Takes the documents of the calls; must not be emptied before the second one came.
        loses: End the connection of the first call, instead of only leaving it without an answer.
    """
    answer = encode_response([1, "", 0])

    async def take(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        length = int(re.findall(rb"(?i)content-length: *(\d+)", head)[0])
        calls.put_nowait(await reader.readexactly(length))
        if calls.qsize() > 1:
            writer.write(
                b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n" % len(answer)
            )
            writer.write(answer)
        elif loses:
            writer.transport.abort()
            return
        await reader.read()  # until the caller ends the connection
        writer.close()

    async with await asyncio.start_server(take, "127.0.0.1") as server:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/"
