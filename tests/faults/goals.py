"""The times that the suite measures, and what they should be. Pure."""

from __future__ import annotations

import statistics
from collections.abc import Iterator

GOALS = {
    "kill -9 of the leading master": 5.0,
    "kill -9 of etcd's leader": 4.0,
    "kill -9 of both": 8.0,
    "kill -9 of both on one machine": 8.0,
    "kill -9 of a stand-by": 4.0,
    "SIGTERM of the leading master": 1.0,
    "drain of the leading master": 1.0,
    "stop of the leading master": 5.0,
    "machine cut off": 8.0,
    "machine hears nothing": 8.0,
    "machine says nothing": 8.0,
    "master cut off from etcd": 8.0,
    "task sets are back": 10.0,
}
"""The longest time until the next write, without one during a hand-over, or until the event, in seconds."""


WITH_ETCD = ", with etcd's leader"
"""At the end of the name of a fault of the leading master's machine if etcd's leader is on it, too."""


class Times:
    """Measured times by what they are of."""

    def __init__(self) -> None:
        self._found: dict[str, list[float]] = {}
        self._checked: dict[str, tuple[int, int]] = {}

    def add(self, what: str, value: float) -> None:
        """Note a time, seconds."""
        self._found.setdefault(what, []).append(value)

    def checked(self, what: str, right: int, wrong: int) -> None:
        """Note how many things were checked, and how many of them were wrong."""
        before = self._checked.get(what, (0, 0))
        self._checked[what] = before[0] + right + wrong, before[1] + wrong

    def table(self) -> Iterator[str]:
        """Return lines with what was measured beside the goals."""
        yield f"{'until the next write, seconds':44} {'n':>4} {'p50':>7} {'max':>7} {'goal':>7}"
        for what, values in self._found.items():
            limit = GOALS.get(what.removesuffix(WITH_ETCD))
            goal = "" if limit is None else f"< {limit:g}"
            middle, most = statistics.median(values), max(values)
            yield f"{what:44} {len(values):4} {middle:7.2f} {most:7.2f} {goal:>7}"
        if self._checked:
            yield f"{'checked':44} {'n':>4} {'wrong':>15} {'goal':>7}"
        for what, (count, wrong) in self._checked.items():
            yield f"{what:44} {count:4} {wrong:15} {'0':>7}"
