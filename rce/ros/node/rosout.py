"""Log records of a node on ``/rosout``."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from rce.ros.errors import NodeClosedError
from rce.ros.node.clock import NANOSECONDS, Clock
from rce.ros.node.publisher import Publisher

TOPIC = "/rosout"
KIND = "rosgraph_msgs/Log"
MD5SUM = "acffd30cd6b6de30f120938c17c593fb"

MAX_WAITING = 100
"""How many records are kept for the first listener."""

MAX_TOPICS = 50
"""A record names the node's topics, but not more: a planner of many robots has hundreds."""

_LEVELS = ((logging.CRITICAL, 16), (logging.ERROR, 8), (logging.WARNING, 4), (logging.INFO, 2))
_DEBUG = 1


class RosoutHandler(logging.Handler):
    """Publishes log records as ``rosgraph_msgs/Log``.

    Records that come before the first listener wait for it; the message type is loaded then.
    Made in the event loop's thread; records of other threads are handed to it.
    """

    def __init__(
        self, publisher: Publisher, node: str, clock: Clock, topics: Callable[[int], list[str]]
    ) -> None:
        super().__init__()
        self._clock = clock
        self._publisher = publisher
        self._node = node
        self._topics = topics
        self._waiting: deque[logging.LogRecord] = deque(maxlen=MAX_WAITING)
        self._loop = asyncio.get_running_loop()
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        """Publish a record, after those that waited."""
        if threading.get_ident() != self._thread:
            with suppress(RuntimeError):  # the loop has ended, and so has the node
                self._loop.call_soon_threadsafe(self.emit, record)
            return
        self._waiting.append(record)
        self.flush()

    def flush(self) -> None:
        """Publish waiting records, if the topic has subscribers."""
        while self._waiting and self._publisher.connections:
            record = self._waiting.popleft()
            try:
                self._publish(record)
            except NodeClosedError:
                return
            except Exception:  # noqa: BLE001 - a record that cannot be formatted must not fail its writer
                self.handleError(record)

    def _publish(self, record: logging.LogRecord) -> None:
        from rce.ros.types import Time

        seconds = self._clock.nanoseconds() / NANOSECONDS if self._clock.simulated else record.created
        secs, fraction = divmod(seconds, 1)
        self._publisher.publish(
            header={"stamp": Time(int(secs), int(fraction * 1e9))},
            level=next((level for floor, level in _LEVELS if record.levelno >= floor), _DEBUG),
            name=self._node,
            msg=self.format(record),
            file=record.pathname,
            function=record.funcName or "",
            line=record.lineno,
            topics=self._topics(MAX_TOPICS),
        )
