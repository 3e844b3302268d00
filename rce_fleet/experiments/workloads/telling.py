"""What a program of an experiment tells by its standard output: that it is ready, and what it has seen.

A line is ``ready``, or ``report`` and a JSON object; all other lines are messages that were printed. The
output is the one way by which a program in a container tells something without using the network measured.

Standard error may be the same file, where libraries write a line and its end one after the other, so what is
told begins with a line end of its own.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

READY = "ready"
REPORT = "report "
LONGEST = 500
"""Values of a list in one line: longer ones are told in several."""
_LOCK = threading.Lock()
"""Held while something is written: each topic of rospy has a thread of its own, and standard output none."""


def tell_ready() -> None:
    """Tell that the program has heard of all others, and when: seconds since 1970."""
    _write(f"\n{READY}\n")
    tell({READY: time.time()})


def tell(report: dict[str, Any]) -> None:
    """Tell a report."""
    _write(f"\n{REPORT}{json.dumps(report)}\n")


def tell_samples(phase: str, topic: str, samples: list[tuple[int, ...]]) -> None:
    """Tell samples of a topic: the stamp of each message, and when it arrived, microseconds since 1970."""
    for begin in range(0, max(1, len(samples)), LONGEST):
        tell({"phase": phase, "topic": topic, "samples": samples[begin : begin + LONGEST]})


def reports(lines: Iterable[str]) -> Iterator[dict[str, Any]]:
    """Yield the reports among the lines of an output."""
    for line in lines:
        if line.startswith(REPORT):
            yield json.loads(line.removeprefix(REPORT))


def show(message: Any) -> None:
    """Print a message as ``rostopic echo`` does."""
    _write(f"{message}\n---\n")


def _write(text: str) -> None:
    with _LOCK:
        sys.stdout.write(text)
        sys.stdout.flush()
