"""The streams of commands that users run: sizes that do not fit, and a machine that has none left."""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from pathlib import Path

import pytest

from rce.control.execution import MAX_DATA, NOT_RUN, Command, Ended, Frame, Part, decode, read_ended
from rce_container.environment.executions import Executions
from rce_container.environment.nodes.reaper import Reaper


async def run(command: Command) -> tuple[list[Frame], Ended]:
    """Run a command as an environment does; return its frames, and how it ended."""
    frames: list[Frame] = []
    loop = asyncio.get_running_loop()
    with Reaper() as reaper:
        executions = Executions(reaper, lambda: {"PATH": os.defpath}, "test-command-streams", "/")
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with ours:
            ours.setblocking(False)
            executions.start(command, theirs)
            async with asyncio.timeout(60):
                while data := await loop.sock_recv(ours, MAX_DATA + 2):
                    frames.append(decode(data))
        await executions.close()
    assert frames, "the user is not told how it ended"
    assert frames[-1].part is Part.ENDED
    return frames, read_ended(frames[-1].data)


def descriptors() -> list[str]:
    """What this process has open."""
    found = Path("/proc/self/fd").iterdir()
    return sorted(f"{path.name} {path.readlink()}" for path in found if path.is_symlink())


@pytest.mark.parametrize("rows", [-1, 70_000])
async def test_a_size_that_does_not_fit_is_passed_over(rows: int) -> None:
    """A master of an earlier release passes it on."""
    before = descriptors()
    for _ in range(2):
        frames, ended = await run(Command(argv=("echo", "hello"), terminal=True, rows=rows))
        assert ended == Ended(code=0)
        assert b"hello" in b"".join(frame.data for frame in frames if frame.part is Part.OUTPUT)
    assert descriptors() == before


@pytest.mark.parametrize("terminal", [True, False])
async def test_a_command_without_streams_says_why(monkeypatch: pytest.MonkeyPatch, terminal: bool) -> None:
    made: list[tuple[int, int]] = []
    pipe = os.pipe2

    def two_pipes(flags: int) -> tuple[int, int]:
        if len(made) == 2:
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        made.append(pipe(flags))
        return made[-1]

    def none_left() -> tuple[int, int]:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(os, "openpty", none_left)
    monkeypatch.setattr(os, "pipe2", two_pipes)
    before = descriptors()
    _, ended = await run(Command(argv=("echo",), terminal=terminal))
    assert ended.code == NOT_RUN
    assert ended.reason.endswith(
        f"cannot make {'a terminal' if terminal else 'its pipes'}: Too many open files"
    )
    assert descriptors() == before
