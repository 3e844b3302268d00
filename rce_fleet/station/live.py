"""Sends changes to every open page, each at its own pace.

A page first gets the complete state, then changes. Changes that are not sent yet wait in a queue; if the page
is too slow, its queue is emptied, and it gets the complete state again. Other messages have a *topic*, and a
page gets the newest of each; events wait in a short queue. A page that stops reading costs some memory and
slows no other page.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

MAX_CHANGES = 50
"""Maximum number of changes that wait for one page."""
MAX_EVENTS = 100

Message: TypeAlias = str | bytes
"""A text, or a frame: of a layer (:mod:`rce_fleet.station.layers.frames`), or of poses
(:mod:`rce_fleet.station.pose_frames`)."""


class Page:
    """The messages that an open page still has to get.

    Args:
        whole: Returns the messages with the complete state.
        takes_changes: Whether the page handles changes; otherwise it gets the complete state after each.
    """

    def __init__(self, whole: Callable[[], Sequence[Message]], *, takes_changes: bool) -> None:
        self._whole = whole
        self._takes_changes = takes_changes
        self._is_behind = True
        self._changes: deque[Message] = deque()
        self._newest: dict[str, Message] = {}
        self._events: deque[str] = deque(maxlen=MAX_EVENTS)
        self._wake = asyncio.Event()
        self._wake.set()

    def put_change(self, message: Message) -> None:
        """Queue a change; a page that handles none, or is too slow, gets the complete state instead."""
        if not self._takes_changes or len(self._changes) >= MAX_CHANGES:
            self._is_behind = True
            self._changes.clear()
        if not self._is_behind:
            self._changes.append(message)
        self._wake.set()

    def put(self, topic: str, message: Message) -> None:
        """Queue a message; it replaces an older one of its topic."""
        self._newest[topic] = message
        self._wake.set()

    def drop(self, topic: str) -> None:
        """Remove a queued message of a topic."""
        self._newest.pop(topic, None)

    def put_event(self, text: str) -> None:
        """Queue an event."""
        self._events.append(text)
        self._wake.set()

    async def take(self) -> list[Message]:
        """Wait for messages, and return them."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            messages = self._take_now()
            if messages:
                return messages

    def _take_now(self) -> list[Message]:
        state = self._whole() if self._is_behind else list(self._changes)
        self._is_behind = self._is_behind and not state
        messages = [*state, *self._newest.values(), *self._events]
        self._changes.clear()
        self._newest.clear()
        self._events.clear()
        return messages


class Broadcast:
    """The open pages, and the newest message of each topic for a page that opens.

    Args:
        whole: Returns the messages with the complete state; none before the first state.
        compact: The same for pages that read frames of poses; ``whole`` if None.
    """

    def __init__(
        self,
        whole: Callable[[], Sequence[Message]] = list,
        compact: Callable[[], Sequence[Message]] | None = None,
    ) -> None:
        self._whole = whole
        self._whole_compact = compact or whole
        self._pages: set[Page] = set()
        self._compact: set[Page] = set()
        self._kept: deque[str] = deque(maxlen=MAX_EVENTS)
        self._newest: dict[str, str] = {}
        self.are_open = asyncio.Event()
        """Set while there is a page."""

    def __iter__(self) -> Iterator[Page]:
        return iter(self._pages)

    def open(self, *, takes_changes: bool = True, compact: bool = False) -> Page:
        """Add a page; it gets the complete state first, and the newest message of every topic.

        Args:
            takes_changes: Whether the page handles changes.
            compact: Whether it reads frames of poses.
        """
        page = Page(self._whole_compact if compact else self._whole, takes_changes=takes_changes)
        if compact:
            self._compact.add(page)
        for topic, text in self._newest.items():
            page.put(topic, text)
        for text in self._kept:
            page.put_event(text)
        self._pages.add(page)
        self.are_open.set()
        return page

    def close(self, page: Page) -> None:
        """Remove a page."""
        self._pages.discard(page)
        self._compact.discard(page)
        if not self._pages:
            self.are_open.clear()

    def send_change(self, text: str) -> None:
        """Send a change to the pages that are open now."""
        for page in self._pages:
            page.put_change(text)

    def send_forms(self, text: Callable[[], str], frame: Callable[[], bytes]) -> None:
        """Send a change that has two forms; each is made only if a page reads it."""
        for pages, make in ((self._pages - self._compact, text), (self._compact, frame)):
            if pages:
                message = make()
                for page in pages:
                    page.put_change(message)

    def send(self, topic: str, text: str) -> None:
        """Send a message to all pages, and keep it for pages that open later."""
        self._newest[topic] = text
        for page in self._pages:
            page.put(topic, text)

    def send_event(self, text: str) -> None:
        """Send an event to the pages that are open now."""
        for page in self._pages:
            page.put_event(text)

    def send_kept_event(self, text: str) -> None:
        """Send an event, and keep it for pages that open later."""
        self._kept.append(text)
        self.send_event(text)
