"""Latched messages of an interface: the last one of each source, at both ends of a connection.

The sending end keeps the payloads, and sends them to each peer that connects later. The receiving end keeps
only which sources it has heard of on which channel, so that it can tell its interface when one ended.

Sources survive the loss of a connection: their messages stay in force until the peer is back and lists the
sources that are in force now (SOURCES), or until the connection is removed.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator

    from rce.guard import Holding, Holdings

MAX_SOURCES = 1024
"""Publishers of one topic whose latched messages are kept."""


@dataclass(eq=False, slots=True)
class Kept:
    """The last message of a source."""

    number: int
    """Names the source on channels."""
    payload: bytes | memoryview
    holding: Holding | None = None


class LatchedMessages:
    """The last message of each source, oldest source first.

    Args:
        holdings: Where the bytes are entered.
        on_given_up: Called with the number of a source whose message was thrown away: memory is short.
        on_ended: Called with the number of a source that was forgotten otherwise.
    """

    def __init__(
        self, holdings: Holdings, on_given_up: Callable[[int], None], on_ended: Callable[[int], None]
    ) -> None:
        self._holdings = holdings
        self._on_given_up = on_given_up
        self._on_ended = on_ended
        self._kept: dict[str, Kept] = {}
        self._numbers = itertools.count(1)

    def __contains__(self, source: object) -> bool:
        return source in self._kept

    def __iter__(self) -> Iterator[Kept]:
        """Iterate over the messages, without those that are thrown away meanwhile."""
        for source, kept in list(self._kept.items()):
            if self._kept.get(source) is kept:
                yield kept

    @property
    def numbers(self) -> tuple[int, ...]:
        """The sources, by number."""
        return tuple(kept.number for kept in self._kept.values())

    def keep(self, source: str, payload: bytes | memoryview) -> int:
        """Keep a message in place of the last one of its source.

        Returns:
            The source's number; 0 if the message was thrown away at once.
        """
        kept = self._kept.get(source)
        if kept is None:
            if len(self._kept) >= MAX_SOURCES:
                self._forget(next(iter(self._kept)))
            kept = self._kept[source] = Kept(next(self._numbers), payload)
        elif kept.holding is not None:
            kept.holding.release()
        kept.payload = payload
        holding = self._holdings.hold(len(payload), lambda: self._give_up(source, kept))
        if self._kept.get(source) is not kept:
            return 0
        kept.holding = holding
        return kept.number

    def retain(self, sources: Collection[str]) -> bool:
        """Forget all but these sources; return whether there were others."""
        ended = [source for source in self._kept if source not in sources]
        for source in ended:
            self._forget(source)
        return bool(ended)

    def _give_up(self, source: str, kept: Kept) -> None:
        if self._kept.get(source) is kept:
            del self._kept[source]
            self._on_given_up(kept.number)

    def _forget(self, source: str) -> None:
        kept = self._kept.pop(source)
        if kept.holding is not None:
            kept.holding.release()
        self._on_ended(kept.number)


class HeardSources:
    """Which sources' latched messages came on which channel: at most :data:`MAX_SOURCES`, oldest first."""

    def __init__(self) -> None:
        self._heard: dict[int, dict[int, None]] = {}

    def note_source(self, channel: int, source: int) -> tuple[str, list[str]]:
        """Note a latched message.

        Returns:
            The name of its source, which no other channel's source has; and that of a source that had to make
            room, because the peer names more than it may.
        """
        heard = self._heard.setdefault(channel, {})
        ended = []
        if source not in heard and len(heard) >= MAX_SOURCES:
            oldest = next(iter(heard))
            del heard[oldest]
            ended.append(_name(channel, oldest))
        heard[source] = None
        return _name(channel, source), ended

    def retain(self, channel: int, sources: Collection[int] = ()) -> list[str]:
        """Forget all sources of a channel but these; return the names of those that were there."""
        heard = self._heard.get(channel, {})
        ended = [source for source in heard if source not in sources]
        for source in ended:
            del heard[source]
        if not heard:
            self._heard.pop(channel, None)
        return [_name(channel, source) for source in ended]


def _name(channel: int, source: int) -> str:
    return f"{channel}.{source}"
