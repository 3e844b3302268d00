"""A process of a node that answers requests one after the other, on its standard input and output.

A request or answer is a frame: 4 bytes with the length, the most significant one first, then the content.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    from asyncio.subprocess import Process
    from collections.abc import Iterator

_LENGTH = 4


def frame(payload: bytes) -> bytes:
    """Return a frame with a content."""
    return len(payload).to_bytes(_LENGTH) + payload


async def ask(process: Process, request: bytes) -> bytes:
    """Send a request to a process, and return the answer.

    Raises:
        asyncio.IncompleteReadError: The process ended.
        ConnectionError: It had ended before.
    """
    assert process.stdin is not None
    process.stdin.write(frame(request))
    await process.stdin.drain()
    return await receive(process)


async def receive(process: Process) -> bytes:
    """Return the next frame that a process sends.

    Raises:
        asyncio.IncompleteReadError: The process ended.
    """
    assert process.stdout is not None
    length = int.from_bytes(await process.stdout.readexactly(_LENGTH))
    return await process.stdout.readexactly(length)


async def end(process: Process, grace: float = 0.0) -> str:
    """End a process, after ``grace`` seconds; return how it ended, in words.

    A process that ends by itself needs the grace: to kill it would take its status from asyncio.
    """
    try:
        async with asyncio.timeout(grace):
            status = await process.wait()
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        status = await process.wait()
    return how_ended(status)


def how_ended(status: int) -> str:
    """Return in words how a process ended."""
    return f"signal {-status}" if status < 0 else f"status {status}"


def requests_of(stream: BinaryIO) -> Iterator[bytes]:
    """Return the requests that come to this process, until its input ends."""
    while len(head := stream.read(_LENGTH)) == _LENGTH:
        yield stream.read(int.from_bytes(head))
