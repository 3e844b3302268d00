"""Whether a history of reads and writes of one register can be put in an order that explains it. Pure.

The search is that of Wing and Gong, with a memory of the states that led nowhere (Lowe).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, replace

SHOWN = 8
"""Operations that a report shows."""


@dataclass(frozen=True, slots=True)
class Operation:
    """A read or a write of a register.

    Attributes:
        start: When it was asked for, seconds.
        end: When it was answered; infinity: it may take effect at any later time, or never.
        value: What was read or written. Each value is written once at most.
    """

    start: float
    end: float
    is_write: bool
    value: int

    @property
    def is_certain(self) -> bool:
        """Whether it was done."""
        return self.end != math.inf

    def __str__(self) -> str:
        return f"[{'write' if self.is_write else 'read'} {self.value}: {self.start:.3f} to {self.end:.3f}]"


def is_linearizable(operations: Iterable[Operation], initial: int) -> bool:
    """Return whether all operations can have happened one by one, each between its start and its end.

    Args:
        operations: In any order. Reads without an answer say nothing.
        initial: The value before the first write.
    """
    history = _relevant(operations)
    certain = sum(1 << index for index, each in enumerate(history) if each.is_certain)
    waiting = [(0, initial)]
    seen = set(waiting)
    while waiting:
        done, value = waiting.pop()
        if certain & ~done == 0:
            return True
        for index in _next(history, done, value):
            each = history[index]
            state = (done | 1 << index, each.value if each.is_write else value)
            if state not in seen:
                seen.add(state)
                waiting.append(state)
    return False


def unexplained(operations: Iterable[Operation], initial: int) -> list[Operation]:
    """Return the last operations of the shortest beginning of a history that cannot be explained."""
    history = sorted(operations, key=lambda each: each.end)
    times = [each.end for each in history if each.is_certain]
    first = bisect_left(times, True, key=lambda time: not is_linearizable(_until(history, time), initial))
    if first == len(times):
        return []
    return _until(history, times[first])[-SHOWN:]


def _until(history: list[Operation], time: float) -> list[Operation]:
    """Return a history as it was known at a time."""
    begun = [each for each in history if each.start <= time]
    return [each if each.end <= time else replace(each, end=math.inf) for each in begun]


def _relevant(operations: Iterable[Operation]) -> list[Operation]:
    """Leave out what explains nothing: reads without an answer, and writes without one that none has read."""
    given = list(operations)
    read = {each.value for each in given if not each.is_write and each.is_certain}
    kept = [each for each in given if each.is_certain or (each.is_write and each.value in read)]
    return sorted(kept, key=lambda each: (each.start, each.end))


def _next(history: list[Operation], done: int, value: int) -> list[int]:
    """Return the operations that may come next: none that is not done ended before they started."""
    found: list[int] = []
    bound = math.inf
    # Those before the first one that is not done are done: its index is the number of ones at the end.
    first = (~done & (done + 1)).bit_length() - 1
    for index in range(first, len(history)):
        each = history[index]
        if each.start > bound:
            break
        if done >> index & 1:
            continue
        bound = min(bound, each.end)
        if each.is_write:
            found.append(index)
        elif each.value == value:
            return [index]  # a read changes nothing: taking it at once is never worse
    return [index for index in found if history[index].start <= bound]
