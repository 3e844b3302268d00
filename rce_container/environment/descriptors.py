"""Reading and writing pipes and terminals without blocking the event loop."""

from __future__ import annotations

import asyncio
import errno
import os


async def read_some(fd: int, size: int) -> bytes:
    """Wait for bytes from a non-blocking descriptor.

    Returns:
        At most ``size`` of them; empty at the end. A terminal ends when its last process closed it.
    """
    loop = asyncio.get_running_loop()
    while True:
        try:
            return os.read(fd, size)
        except BlockingIOError:
            ready = loop.create_future()
            loop.add_reader(fd, _wake, ready)
            try:
                await ready
            finally:
                loop.remove_reader(fd)
        except OSError as error:
            if error.errno == errno.EIO:
                return b""
            raise


async def write_all(fd: int, data: bytes) -> None:
    """Write bytes to a non-blocking descriptor, as fast as they are taken.

    Raises:
        OSError: Nothing reads there any more.
    """
    loop = asyncio.get_running_loop()
    rest = memoryview(data)
    while rest:
        try:
            rest = rest[os.write(fd, rest) :]
        except BlockingIOError:
            ready = loop.create_future()
            loop.add_writer(fd, _wake, ready)
            try:
                await ready
            finally:
                loop.remove_writer(fd)


def _wake(ready: asyncio.Future[None]) -> None:
    if not ready.done():
        ready.set_result(None)
