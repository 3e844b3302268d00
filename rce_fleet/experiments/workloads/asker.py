"""Measures round trips: ``asker TOPIC BACK BYTES:TRIPS...`` publishes, and waits until it comes back.

A message is a number of seven digits and, up to its size, the letter ``x``. The program tells the trips of
each size, seconds, and how many did not come back.
"""

from __future__ import annotations

import argparse
import threading
import time
from typing import TYPE_CHECKING, Any

from .echo import KIND
from .graph import open_graph
from .telling import tell, tell_ready

if TYPE_CHECKING:
    from .graph import Output

POLL_S = 0.05
DIGITS = 7
"""Size of the smallest message, bytes."""
FIRST_S = 0.5
"""After so many seconds the first message is sent again: it is lost until all are connected."""
WARMED_UP_BYTES = 100_000
"""Up to this size the first trip of a size is not counted."""


class Asker:
    """Sends the messages one after another.

    Args:
        output: Where they are sent.
        sizes: Bytes and number of trips of each size.
        patience: A message that is not back after so many seconds is lost.
    """

    def __init__(self, output: Output, sizes: list[tuple[int, int]], patience: float) -> None:
        self._output = output
        self._patience = patience
        self._lock = threading.Lock()
        self._plan = [size for size, trips in sizes for _ in range(trips + (size <= WARMED_UP_BYTES))]
        self._trips: dict[int, list[float | None]] = {size: [] for size, _ in sizes}
        self._number = -1
        """Of the message under way; -1: the first one, which finds out whether all are connected."""
        self._text = ""
        self._sent_at = 0.0
        self._is_told = False

    def take(self, message: Any) -> None:
        """Take a message that came back."""
        now = time.monotonic()
        with self._lock:
            if message.data[:DIGITS] != self._text[:DIGITS] or self._is_told:
                return
            if self._number < 0:
                tell_ready()
            self._note(now - self._sent_at)
            self._next()

    def step(self) -> float:
        """Send what is due; return the seconds until the next call."""
        with self._lock:
            waited = time.monotonic() - self._sent_at
            if self._is_told:
                return POLL_S
            if self._number < 0 and waited > FIRST_S:
                self._send(DIGITS)
            elif self._number >= 0 and waited > self._patience:
                self._note(None)
                self._next()
        return POLL_S

    def _next(self) -> None:
        self._number += 1
        if self._number < len(self._plan):
            self._send(self._plan[self._number])
            return
        self._is_told = True
        for size, found in self._trips.items():
            counted = found[1:] if size <= WARMED_UP_BYTES else found
            trips = [trip for trip in counted if trip is not None]
            tell({"bytes": size, "trips": trips, "lost": len(counted) - len(trips)})
        tell({"phase": "end"})

    def _note(self, trip: float | None) -> None:
        if self._number >= 0:
            self._trips[self._plan[self._number]].append(trip)

    def _send(self, size: int) -> None:
        self._text = f"{self._number % 10**DIGITS:0{DIGITS}d}".ljust(size, "x")
        self._sent_at = time.monotonic()
        self._output.send({"data": self._text})


def main() -> None:
    """Run the program until it is told to stop."""
    parser = argparse.ArgumentParser(prog="asker", description=__doc__)
    parser.add_argument("topic")
    parser.add_argument("back")
    parser.add_argument("sizes", nargs="+", metavar="BYTES:TRIPS")
    parser.add_argument("--patience", type=float, default=10.0)
    options = parser.parse_args()
    sizes = [(int(size), int(trips)) for size, _, trips in (text.partition(":") for text in options.sizes)]
    graph = open_graph("asker")
    asker = Asker(graph.output(options.topic, KIND), sizes, options.patience)
    graph.take(options.back, KIND, asker.take)
    graph.run(asker.step)


if __name__ == "__main__":
    main()
