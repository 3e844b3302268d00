"""Logs of bounded size: rows of segments, each named by the offset of its first byte.

``echo.000001048576.log`` holds the log of ``echo`` after its first megabyte.
An offset counts the bytes since the log began, so it stays valid when old segments are thrown away, and a
reader in another process needs nothing but the folder.
"""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

ENVIRONMENT_LOG = "_environment"
"""The environment's own log; no node can be called like that."""

SEGMENT_BYTES = 1 << 20
SEGMENTS = 2
"""How many segments are kept."""

_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
_CHUNK = 1 << 16
_RATE_WINDOW_S = 0.25
_RATE_BYTES = 2 << 20
_TAIL_BYTES = 2048


def segment_path(folder: Path, name: str, start: int) -> Path:
    """The file that holds a log from offset ``start``."""
    return folder / f"{name}.{start:012d}.log"


def segments(folder: Path, name: str) -> list[tuple[int, Path]]:
    """The kept segments of a log as (offset of the first byte, file), oldest first."""
    found = []
    for path in folder.glob(f"{name}.*.log"):
        start = path.name[len(name) + 1 : -len(".log")]
        if start.isdigit():
            found.append((int(start), path))
    return sorted(found)


class LogWriter:
    """Appends to a log and keeps its size bounded. Goes on where an earlier writer ended.

    Args:
        folder: Where the segments are.
        name: The log's name.
        segment_bytes: A segment that reached this size is followed by a new one.
        mirror: Descriptors that shall always lead to the newest segment (1 and 2 for a process's own log).
    """

    def __init__(
        self, folder: Path, name: str, *, segment_bytes: int = SEGMENT_BYTES, mirror: tuple[int, ...] = ()
    ) -> None:
        self._folder = folder
        self._name = name
        self._segment_bytes = segment_bytes
        self._mirror = mirror
        kept = segments(folder, name)
        self._start = kept[-1][0] if kept else 0
        self._tail = b""
        self._fd = self._open()

    def write(self, data: bytes) -> None:
        """Append. A full disk loses the data and nothing else."""
        self._tail = (self._tail + data[-_TAIL_BYTES:])[-_TAIL_BYTES:]
        try:
            if os.fstat(self._fd).st_size >= self._segment_bytes:
                self._rotate()
            os.write(self._fd, data)
        except OSError:
            return

    @property
    def last_line(self) -> str:
        """The last line with something in it that was written, without the white space around it."""
        lines = self._tail.decode(errors="replace").strip().splitlines()
        return lines[-1].strip() if lines else ""

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)

    def _open(self) -> int:
        fd = os.open(segment_path(self._folder, self._name, self._start), _FLAGS, 0o600)
        for mirrored in self._mirror:
            os.dup2(fd, mirrored)
        return fd

    def _rotate(self) -> None:
        start, old = self._start, self._fd
        self._start += os.fstat(old).st_size
        try:
            self._fd = self._open()
        except OSError:
            self._start = start
            raise
        os.close(old)
        for _, path in segments(self._folder, self._name)[:-SEGMENTS]:
            path.unlink(missing_ok=True)


class Pump:
    """Moves what comes out of a pipe into a log, and slows down a writer that floods it.

    Args:
        pipe: The reading end; the pump owns it.
        log: Where it goes.
    """

    def __init__(self, pipe: int, log: LogWriter) -> None:
        os.set_blocking(pipe, False)
        self._loop = asyncio.get_running_loop()
        self._pipe = pipe
        self._log = log
        self._open = True
        self._window_bytes = 0
        self._window_end = 0.0
        self._resume: asyncio.TimerHandle | None = None
        self._loop.add_reader(pipe, self._read)

    def close(self) -> None:
        """Take what is in the pipe still, and close it."""
        for _ in range(_RATE_BYTES // _CHUNK):
            if not self._open or not self._move():
                break
        self._end()

    def _read(self) -> None:
        if not self._move():
            return
        now = self._loop.time()
        if now >= self._window_end:
            self._window_end = now + _RATE_WINDOW_S
            self._window_bytes = 0
        elif self._window_bytes > _RATE_BYTES:
            self._loop.remove_reader(self._pipe)
            self._resume = self._loop.call_at(self._window_end, self._go_on)

    def _go_on(self) -> None:
        self._resume = None
        self._loop.add_reader(self._pipe, self._read)

    def _move(self) -> bool:
        """Move one chunk; whether there may be more."""
        try:
            data = os.read(self._pipe, _CHUNK)
        except (BlockingIOError, InterruptedError):
            return False
        if not data:
            self._end()
            return False
        self._window_bytes += len(data)
        self._log.write(data)
        return True

    def _end(self) -> None:
        if not self._open:
            return
        self._open = False
        if self._resume is not None:
            self._resume.cancel()
        self._loop.remove_reader(self._pipe)
        os.close(self._pipe)
