"""How a node's log keeps its streams apart: each piece of a line begins with a letter. Pure.

A log is a sequence of *fragments*: a letter, some text, a newline. A lower-case letter means that the line
ends with the fragment; an upper-case letter means that it continues in a later fragment of the same letter.
The letter names the stream and, for ROS's log records, their level. So a reader gets all or some streams in
order of arrival, and a node's output cannot imitate another stream.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

from rce.control import LogLevel, LogStream
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
    """Return the letter of a log level; for a level that ROS does not have, of the next lower one."""
    return _ROSOUT[max((known for known in _ROSOUT if known <= level), default=Level.DEBUG)]


def letters_of(streams: Collection[LogStream], level: LogLevel = LogLevel.DEBUG) -> bytes:
    """Return the letters of some streams; of all streams if none are given.

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
    """Return the length of the data up to an incomplete UTF-8 character at its end."""
    for back in range(1, min(_MAX_TAIL, len(data)) + 1):
        byte = data[-back]
        if byte & _CONTINUATION_MASK != _CONTINUATION:
            needed = 1 + (byte >= 0xC0) + (byte >= 0xE0) + (byte >= 0xF0)  # noqa: PLR2004 - UTF-8's first bytes
            return len(data) if needed <= back else len(data) - back
    return len(data)


def text_of(log: bytes, letters: bytes) -> bytes:
    """Return the text of whole fragments, only of those with some letters (see :func:`letters_of`)."""
    wanted = letters + letters.upper()
    found = []
    for fragment in log.split(b"\n"):
        if fragment[:1] and fragment[:1] in wanted:
            found.append(fragment[1:])
            if fragment[:1].islower():
                found.append(b"\n")
    return b"".join(found)
