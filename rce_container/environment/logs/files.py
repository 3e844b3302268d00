"""Logs of bounded size: sequences of segments, each named by the offset of its first byte.

``echo.000001048576.log`` holds the log of ``echo`` after its first megabyte.
An offset counts the bytes since the log began, so it stays valid when old segments are removed, and a reader
in another process needs only the folder.
"""

from __future__ import annotations

import os
from pathlib import Path

ENVIRONMENT_LOG = "_environment"
"""The environment's own log; a node cannot have this name."""
ROSOUT_LOG = "_rosout"
"""All nodes' log records in ROS, as ROS's own ``rosout.log`` holds them."""

SEGMENT_BYTES = 1 << 20
SEGMENTS = 2
"""How many segments are kept."""

_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC


def segment_path(folder: Path, name: str, start: int) -> Path:
    """Return the file that holds a log from offset ``start``."""
    return folder / f"{name}.{start:012d}.log"


def segments(folder: Path, name: str) -> list[tuple[int, Path]]:
    """Return the kept segments of a log as (offset of the first byte, file), oldest first."""
    found = []
    for path in folder.glob(f"{name}.*.log"):
        start = path.name[len(name) + 1 : -len(".log")]
        if start.isascii() and start.isdigit():
            found.append((int(start), path))
    return sorted(found)


def remove_log(folder: Path, name: str) -> None:
    """Remove all segments of a log that has no writer."""
    for _, path in segments(folder, name):
        path.unlink(missing_ok=True)


class LogWriter:
    """Appends to a log and keeps its size bounded. Continues where an earlier writer ended.

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
        self._torn = False
        """The last write was cut off: the disk was full."""
        kept = segments(folder, name)
        self._start = kept[-1][0] if kept else 0
        self._fd = self._open()

    def write(self, data: bytes) -> None:
        """Append data. On a full disk only this data is lost; a line that was cut off ends there."""
        try:
            if os.fstat(self._fd).st_size >= self._segment_bytes:
                self._rotate()
            if self._torn:
                data = b"\n" + data
            self._torn = os.write(self._fd, data) < len(data)
        except OSError:
            return

    def close(self) -> None:
        """Close the file; later writes are lost."""
        os.close(self._fd)
        self._fd = -1

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
