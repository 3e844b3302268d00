"""Sends changes to every open page, each at its own pace.

A message has a *topic*; a page that is slow gets only the newest message of each topic (events, which must
not be lost, are kept in a short queue). A page that stops reading costs some memory and slows no other page.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Iterator

MAX_EVENTS = 100


class Page:
    """The messages that an open page still has to get."""

    def __init__(self) -> None:
        self._newest: dict[str, str] = {}
        self._events: deque[str] = deque(maxlen=MAX_EVENTS)
        self._wake = asyncio.Event()

    def put(self, topic: str, text: str) -> None:
        """Queue a message; it replaces an older one of its topic."""
        self._newest[topic] = text
        self._wake.set()

    def put_event(self, text: str) -> None:
        """Queue an event."""
        self._events.append(text)
        self._wake.set()

    async def take(self) -> list[str]:
        """Wait for messages, and return them."""
        await self._wake.wait()
        self._wake.clear()
        texts = [*self._newest.values(), *self._events]
        self._newest.clear()
        self._events.clear()
        return texts


class Broadcast:
    """The open pages, and the newest message of each topic for a page that opens."""

    def __init__(self) -> None:
        self._pages: set[Page] = set()
        self._newest: dict[str, str] = {}

    def __iter__(self) -> Iterator[Page]:
        return iter(self._pages)

    def open(self) -> Page:
        """Add a page; it gets the newest message of every topic first."""
        page = Page()
        for topic, text in self._newest.items():
            page.put(topic, text)
        self._pages.add(page)
        return page

    def close(self, page: Page) -> None:
        """Remove a page."""
        self._pages.discard(page)

    def send(self, topic: str, text: str) -> None:
        """Send a message to all pages, and keep it for pages that open later."""
        self._newest[topic] = text
        for page in self._pages:
            page.put(topic, text)

    def send_event(self, text: str) -> None:
        """Send an event to the pages that are open now."""
        for page in self._pages:
            page.put_event(text)
