"""Log records of ROS nodes as they are on the wire (``rosgraph_msgs/Log``) and in ROS's log files.

Parsed by hand: programs that only keep records need not load the message type. Pure.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import NamedTuple

KIND = "rosgraph_msgs/Log"
MD5SUM = "acffd30cd6b6de30f120938c17c593fb"

_STAMP = struct.Struct("<4xII")
"""Header: sequence number, seconds, nanoseconds; the frame's name follows."""
_WORD = struct.Struct("<I")


class Level(IntEnum):
    """The severity of a record."""

    DEBUG = 1
    INFO = 2
    WARN = 4
    ERROR = 8
    FATAL = 16


_NAMES: dict[int, str] = {level.value: level.name for level in Level}


class LogRecord(NamedTuple):
    """One record."""

    secs: int
    nsecs: int
    level: int
    """A :class:`Level`, or any number that the node chose."""
    name: str
    """The node's global name."""
    text: str
    file: str
    function: str
    line: int
    topics: tuple[str, ...]
    """The topics that the node publishes."""

    @property
    def level_name(self) -> str:
        """The level in capitals, or its number if it is not one of ROS's."""
        return _NAMES.get(self.level) or str(self.level)

    def in_file(self) -> str:
        """The line that ROS's own ``rosout`` node writes to ``rosout.log``, without its end.

        Source: what the binary of Debian's package ``rosout`` 1.15.15 was seen to write.
        """
        place = f"[{self.file}:{self.line}({self.function})] [topics: {', '.join(self.topics)}]"
        return f"{self.secs}.{self.nsecs:09d} {self.level_name} {self.name} {place} {self.text}"

    def on_console(self) -> str:
        """The line that a node prints of it by default, without its end."""
        return f"[{self.level_name}] [{self.secs}.{self.nsecs // 1000:06d}]: {self.text}"


def started(seconds: float) -> str:
    """Return the first line of ROS's ``rosout`` node when it starts, at that many seconds since the epoch."""
    return f"\n\n{seconds:.9f}  Node Startup\n"


def read_record(payload: bytes | memoryview) -> LogRecord:
    """Read a record; bytes that are not UTF-8 are replaced.

    Raises:
        ValueError: The data is not a record.
    """
    try:
        return _Reader(payload).record()
    except struct.error as error:
        raise ValueError(f"no log record: {error}") from error


class _Reader:
    def __init__(self, payload: bytes | memoryview) -> None:
        self._payload = memoryview(payload)
        self._at = 0

    def record(self) -> LogRecord:
        secs, nsecs = _STAMP.unpack_from(self._payload)
        self._at = _STAMP.size
        self._text()  # the header's frame
        level = self._payload[self._at] if self._at < len(self._payload) else 0
        self._at += 1
        name, text, file, function = (self._text() for _ in range(4))
        line = self._number()
        topics = tuple(self._text() for _ in range(self._count()))
        return LogRecord(secs, nsecs, level, name, text, file, function, line, topics)

    def _number(self) -> int:
        (number,) = _WORD.unpack_from(self._payload, self._at)
        self._at += _WORD.size
        return int(number)

    def _count(self) -> int:
        """A number of strings that there is room for."""
        count = self._number()
        if count * _WORD.size > len(self._payload) - self._at:
            raise ValueError(f"no log record: it claims to hold {count} topics")
        return count

    def _text(self) -> str:
        length = self._number()
        end = self._at + length
        if end > len(self._payload):
            raise ValueError(f"no log record: a text of {length} bytes is cut off")
        text = str(self._payload[self._at : end], "utf-8", "replace")
        self._at = end
        return text
