"""What came for interfaces that the program has not made yet. Pure."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rce.protocol import memory_of

if TYPE_CHECKING:
    from rce.protocol import DataMessage

_log = logging.getLogger(__name__)

MAX_TOPICS = 64
"""Topics whose last message is kept."""
MAX_SOURCES = 1024
"""Sources of latched messages whose last one is kept; the engine sends it once."""
MAX_BYTES = 256 << 20
"""Memory of either; a single larger message is kept all the same."""


class EarlyMessages:
    """The last message of each topic, and of each source of latched ones."""

    def __init__(self) -> None:
        self._latched = _Newest("latched messages", MAX_SOURCES)
        self._others = _Newest("messages", MAX_TOPICS)

    def keep(self, message: DataMessage) -> None:
        """Keep a message in place of the last one of its topic and source; drop the oldest of its kind."""
        (self._latched if message.latch else self._others).keep(message)

    def take(self, tag: str) -> list[DataMessage]:
        """Remove and return the messages for an interface, the latched ones first."""
        return self._latched.take(tag) + self._others.take(tag)

    def clear(self) -> None:
        """Forget all."""
        self._latched.clear()
        self._others.clear()


class _Newest:
    """The newest messages of one kind, oldest first."""

    def __init__(self, kind: str, most: int) -> None:
        self._kind = kind
        self._most = most
        self._kept: dict[tuple[str, str], tuple[DataMessage, int]] = {}
        """By interface tag and source, with its memory."""
        self._bytes = 0
        self._told = False

    def keep(self, message: DataMessage) -> None:
        key = message.i_tag, message.latch
        if key in self._kept:
            self._pop(key)
        size = memory_of(message.msg)
        self._kept[key] = message, size
        self._bytes += size
        while len(self._kept) > self._most or (self._bytes > MAX_BYTES and len(self._kept) > 1):
            self._tell_dropped(self._pop(next(iter(self._kept))))

    def take(self, tag: str) -> list[DataMessage]:
        return [self._pop(key) for key in [key for key in self._kept if key[0] == tag]]

    def clear(self) -> None:
        self._kept.clear()
        self._bytes = 0
        self._told = False

    def _pop(self, key: tuple[str, str]) -> DataMessage:
        message, size = self._kept.pop(key)
        self._bytes -= size
        return message

    def _tell_dropped(self, message: DataMessage) -> None:
        """Log the first: a topic that sends all the time must not fill the log."""
        if not self._told:
            self._told = True
            _log.warning(
                "%s: many %s came for interfaces that this program has not made; the oldest are dropped",
                message.i_tag,
                self._kind,
            )
