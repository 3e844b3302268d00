"""Reading the logs that environments write. A container's nodes can do with these files what they like."""

from __future__ import annotations

import codecs
import os
import stat
from pathlib import Path
from typing import NamedTuple

from rce_container.environment.logs import ENVIRONMENT_LOG, segments

MAX_CHUNK = 1 << 20
_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


class Chunk(NamedTuple):
    """A piece of a log."""

    text: str
    offset: int
    """Where the next read goes on."""


def read_log(folder: Path, node: str, offset: int, limit: int) -> Chunk:
    """Read a piece of a node's log.

    Args:
        folder: The container's log folder.
        node: The node's tag; empty for the environment's own log.
        offset: Bytes since the log began; negative counts from its end. What is not kept
            any more is passed over.
        limit: Bytes to read at most.

    Raises:
        OSError: The log cannot be read; ``FileNotFoundError`` if there is none.
    """
    kept = [(start, path, _size(path)) for start, path in segments(folder, node or ENVIRONMENT_LOG)]
    if not kept:
        raise FileNotFoundError(f"there is no log of {node or 'the environment'}")
    end = kept[-1][0] + kept[-1][2]
    if offset < 0:
        offset = end + offset
    offset = min(max(offset, kept[0][0]), end)
    data = bytearray()
    limit = max(1, min(limit, MAX_CHUNK))
    at = offset
    for start, path, size in kept:
        if start <= at < start + size and len(data) < limit:
            data += _read(path, at - start, min(limit - len(data), start + size - at))
            at = offset + len(data)
    text, used = _decode(bytes(data))
    return Chunk(text, offset + used)


def _size(path: Path) -> int:
    found = path.lstat()
    return found.st_size if stat.S_ISREG(found.st_mode) else 0


def _read(path: Path, offset: int, count: int) -> bytes:
    fd = os.open(path, _FLAGS)
    try:
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            return b""
        return os.pread(fd, count, offset)
    finally:
        os.close(fd)


def _decode(data: bytes) -> tuple[str, int]:
    """Decode UTF-8; an unfinished character at the end is left for the next read if it can be."""
    decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
    text = decoder.decode(data)
    rest = len(decoder.getstate()[0])
    if rest and rest == len(data):
        return data.decode(errors="replace"), len(data)
    return text, len(data) - rest
