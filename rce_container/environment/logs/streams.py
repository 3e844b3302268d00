"""How a node's log keeps apart what comes from where: each piece of a line begins with a letter. Pure.

A log is a row of *fragments*: a letter, some text, a newline. A small letter means that the line ends with
the fragment, the capital that it continues in a later one of the same letter. The letter tells the stream,
and of ROS's log records how serious it is. So a log is read in the order in which it came, all or some of
its streams, and nothing that a node prints can look like something else.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

from rce.control.logs import LogLevel, LogStream
from rce.ros.logrecord import Level

FRAGMENT_BYTES = 4096
"""The most text that one fragment holds."""

STDOUT = b"o"
STDERR = b"e"
ENGINE = b"x"
_ROSOUT: dict[int, bytes] = {
    Level.DEBUG: b"d",
    Level.INFO: b"i",
    Level.WARN: b"w",
    Level.ERROR: b"r",
    Level.FATAL: b"f",
}
_LETTERS: dict[LogStream, bytes] = {
    LogStream.STDOUT: STDOUT,
    LogStream.STDERR: STDERR,
    LogStream.ROSOUT: b"".join(_ROSOUT.values()),
    LogStream.ENGINE: ENGINE,
}
_CONTINUATION = 0x80
_CONTINUATION_MASK = 0xC0
_MAX_TAIL = 3
"""Bytes that a character of UTF-8 may have after its first."""


def letter_of(level: int) -> bytes:
    """The letter of log records of a level; that of the next lower one for a level that ROS does not have."""
    return _ROSOUT[max((known for known in _ROSOUT if known <= level), default=Level.DEBUG)]


def letters_of(streams: Collection[LogStream], level: LogLevel = LogLevel.DEBUG) -> bytes:
    """The letters of some streams, all if there are none.

    Args:
        streams: Which.
        level: Of ROS's log records only those that are at least as serious.
    """
    wanted = b"".join(_LETTERS[stream] for stream in LogStream if not streams or stream in streams)
    too_low = b"".join(letter for known, letter in _ROSOUT.items() if known < Level[level.name])
    return wanted.translate(None, too_low)


def fragments(letter: bytes, data: bytes) -> bytes:
    """Put text into fragments; the last one continues later if the text does not end with a newline.

    Args:
        letter: The stream's.
        data: Not empty. Whole characters, so that none is cut in two where another stream comes between.
    """
    lines = data.split(b"\n")
    rest = lines.pop()
    found = [part for line in lines for part in _cut(letter, line)]
    if rest:
        found += (part[:1].upper() + part[1:] for part in _cut(letter, rest))
    return b"".join(found)


def _cut(letter: bytes, line: bytes) -> Iterator[bytes]:
    while len(line) > FRAGMENT_BYTES:
        at = whole_characters(line[:FRAGMENT_BYTES])
        yield b"%b%b\n" % (letter.upper(), line[:at])
        line = line[at:]
    yield b"%b%b\n" % (letter, line)


def whole_characters(data: bytes) -> int:
    """How much of it does not end within a character of UTF-8."""
    for back in range(1, min(_MAX_TAIL, len(data)) + 1):
        byte = data[-back]
        if byte & _CONTINUATION_MASK != _CONTINUATION:
            needed = 1 + (byte >= 0xC0) + (byte >= 0xE0) + (byte >= 0xF0)  # noqa: PLR2004 - UTF-8's first bytes
            return len(data) if needed <= back else len(data) - back
    return len(data)


def text_of(log: bytes, letters: bytes) -> bytes:
    """The text of whole fragments, of those with one of some letters (see :func:`letters_of`) only."""
    wanted = letters + letters.upper()
    found = []
    for fragment in log.split(b"\n"):
        if fragment[:1] and fragment[:1] in wanted:
            found.append(fragment[1:])
            if fragment[:1].islower():
                found.append(b"\n")
    return b"".join(found)
