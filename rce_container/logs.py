"""Reads the logs that environments write. A container's nodes may change these files in any way."""

from __future__ import annotations

import codecs
import os
import stat
from pathlib import Path
from typing import NamedTuple

from rce.printable import one_line
from rce_container.environment.logs.files import ENVIRONMENT_LOG, ROSOUT_LOG, segments
from rce_container.environment.logs.streams import FRAGMENT_BYTES, text_of

MAX_CHUNK = 1 << 20
_MIN_FRAGMENTS = 2 * (FRAGMENT_BYTES + 2)
"""Bytes; enough to find the beginning of a fragment, and to read it whole."""
_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


class Chunk(NamedTuple):
    """A piece of a log."""

    text: str
    offset: int
    """Where the next read continues."""


class _Raw(NamedTuple):
    data: bytes
    offset: int
    """Of its first byte."""
    is_start: bool
    """Whether it is the beginning of what is kept."""


def read_log(folder: Path, name: str, offset: int, limit: int) -> Chunk:
    """Read a piece of a log of plain text: the environment's own, or that of ROS's log records.

    Args:
        folder: The container's log folder.
        name: The log's name.
        offset: Bytes since the log began; negative counts from its end. Skips data that is not kept any more.
        limit: Bytes to read at most.

    Raises:
        OSError: The log cannot be read; ``FileNotFoundError`` if it does not exist.
    """
    raw = _raw(folder, name, offset, max(1, min(limit, MAX_CHUNK)))
    text, used = _decode(raw.data)
    return Chunk(text, raw.offset + used)


def read_node_log(folder: Path, tag: str, offset: int, limit: int, letters: bytes) -> Chunk:
    """Read a piece of a node's log, whole lines or whole parts of very long ones.

    Args:
        folder: The container's log folder.
        tag: The node.
        offset: As for :func:`read_log`; within a line, the next one is meant.
        limit: Maximum of bytes of the log to read, but at least one whole fragment.
        letters: Of which streams (:func:`rce_container.environment.logs.streams.letters_of`). Other streams
            are skipped: the text may be empty although the log continues.

    Raises:
        OSError: As for :func:`read_log`.
    """
    raw = _raw(folder, tag, offset, max(_MIN_FRAGMENTS, min(limit, MAX_CHUNK)), before=1)
    begin = 0 if raw.is_start else raw.data.find(b"\n") + 1
    end = raw.data.rfind(b"\n") + 1
    if not end:  # empty, or not written by an environment
        used = len(raw.data) if len(raw.data) >= _MIN_FRAGMENTS or not raw.is_start else 0
        return Chunk("", raw.offset + used)
    return Chunk(text_of(raw.data[begin:end], letters).decode(errors="replace"), raw.offset + end)


def last_line(folder: Path, name: str = ENVIRONMENT_LOG, *, within: int = 4096) -> str:
    """Return the last line of a plain log that is not blank; empty if none can be read."""
    try:
        text = read_log(folder, name, -within, within).text
    except OSError:
        return ""
    lines = text.strip().splitlines()
    return one_line(lines[-1].strip()) if lines else ""


def _raw(folder: Path, name: str, offset: int, limit: int, *, before: int = 0) -> _Raw:
    """Read bytes, and up to ``before`` bytes in front of them."""
    found = [(start, path, _size(path)) for start, path in segments(folder, name)]
    kept = [(start, path, size) for start, path, size in found if size is not None]
    if not kept:
        what = {ENVIRONMENT_LOG: "the environment", ROSOUT_LOG: "ROS's log records"}.get(name, name)
        raise FileNotFoundError(f"there is no log of {what}")
    first, end = kept[0][0], kept[-1][0] + kept[-1][2]
    if offset < 0:
        offset = end + offset
    offset = max(min(max(offset, first), end) - before, first)
    data = bytearray()
    at = offset
    for start, path, size in kept:
        if start <= at < start + size and len(data) < limit:
            try:
                data += _read(path, at - start, min(limit - len(data), start + size - at))
            except FileNotFoundError:  # the environment removed it meanwhile: what is kept begins after it
                if data:
                    break
                first = offset = start + size
            at = offset + len(data)
    return _Raw(bytes(data), offset, offset == first)


def _size(path: Path) -> int | None:
    """Return the size of a segment; None if the environment removed it meanwhile."""
    try:
        found = path.lstat()
    except FileNotFoundError:
        return None
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
    """Decode UTF-8; leave an unfinished character at the end for the next read if possible."""
    decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
    text = decoder.decode(data)
    rest = len(decoder.getstate()[0])
    if rest and rest == len(data):
        return data.decode(errors="replace"), len(data)
    return text, len(data) - rest
