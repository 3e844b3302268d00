"""Rates of the engine's connections, from the counters of their interfaces. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any, NamedTuple

WINDOW_S = 15.0
"""Rates are means over about this time: interfaces report their counters now and then."""


_ENDS = 2
"""Readings that a rate needs: at the beginning and the end of its time."""


class Rate(NamedTuple):
    """What an interface or a connection carries.

    Attributes:
        messages: Messages in a second, both directions together.
        bytes: Bytes in a second.
    """

    messages: float
    bytes: float


class InterfaceRates:
    """Makes rates of counters.

    An interface counts for all its connections together. What a connection carries is taken from the end that
    exchanges less: it usually has this connection only.
    """

    def __init__(self) -> None:
        self._readings: deque[tuple[float, dict[str, tuple[int, int]]]] = deque()

    def take(self, now: float, interfaces: Iterable[dict[str, Any]]) -> None:
        """Note the counters of all interfaces.

        Args:
            now: Seconds.
            interfaces: Items of the master's ``/interfaces``.
        """
        counters = {
            f"{item['endpoint']}/{item['tag']}": (
                item["messages_in"] + item["messages_out"],
                item["bytes_in"] + item["bytes_out"],
            )
            for item in interfaces
        }
        self._readings.append((now, counters))
        while len(self._readings) > _ENDS and now - self._readings[1][0] >= WINDOW_S:
            self._readings.popleft()

    def of_interface(self, tag: str) -> Rate | None:
        """Return the rate of an interface, ``ENDPOINT/TAG``; None if it is not known yet.

        Counters that went back, because an endpoint was started again, count from 0.
        """
        if len(self._readings) < _ENDS or tag not in self._readings[-1][1]:
            return None
        (since, first), (now, last) = self._readings[0], self._readings[-1]
        before = first.get(tag, (0, 0))
        if now <= since:
            return None
        messages, size = (
            new - old if new >= old else new for new, old in zip(last[tag], before, strict=True)
        )
        return Rate(messages / (now - since), size / (now - since))

    def of_connection(self, tag_a: str, tag_b: str) -> Rate | None:
        """Return the rate of a connection between two interfaces; None if it is not known yet."""
        known = [rate for rate in map(self.of_interface, (tag_a, tag_b)) if rate is not None]
        return min(known, default=None)
