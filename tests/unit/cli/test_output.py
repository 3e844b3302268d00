"""Output that is written in a thread."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
from collections.abc import Iterator

import pytest

from rce_master.cli.output import OutputWriter

PAGE = 4096


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """A pipe for one page."""
    ours, theirs = os.pipe()
    fcntl.fcntl(theirs, fcntl.F_SETPIPE_SZ, PAGE)
    yield ours, theirs
    for fd in (ours, theirs):
        with contextlib.suppress(OSError):  # closed by the test
            os.close(fd)


async def test_a_full_pipe_does_not_block(pipe: tuple[int, int]) -> None:
    ours, theirs = pipe
    first, second = os.urandom(PAGE), os.urandom(3000)
    with OutputWriter() as writer:
        writer.write(theirs, first)
        writer.write(theirs, second)
        assert await writer.written() == PAGE
        draining = asyncio.create_task(writer.drain())
        await asyncio.sleep(0.05)
        assert not draining.done()
        assert writer.stuck_for >= 0.05
        assert os.read(ours, PAGE) == first
        await draining
        assert writer.stuck_for == 0
        assert await writer.written() == 3000
    assert os.read(ours, PAGE) == second


async def test_a_reader_that_ends_is_told(pipe: tuple[int, int]) -> None:
    ours, theirs = pipe
    os.close(ours)
    with OutputWriter() as writer:
        writer.write(theirs, b"x")
        with pytest.raises(BrokenPipeError):
            await writer.written()
        with pytest.raises(BrokenPipeError):
            await writer.drain()


async def test_nothing_to_write_is_written_at_once() -> None:
    with OutputWriter() as writer:
        await writer.drain()
