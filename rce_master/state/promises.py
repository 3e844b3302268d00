"""What containers are promised, summed up: of each machine, and of each user."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rce.model import Resources

_MICRO = 1_000_000


@dataclass(slots=True)
class Promise:
    """The sum of what some containers ask for.

    Whole numbers only: a sum of fractions that is added to and subtracted from would drift.
    """

    slots: int = 0
    micro_cores: int = 0
    memory: int = 0
    """Bytes, of those that ask for memory."""
    slots_without_memory: int = 0
    """Slots of those that do not: each counts with its slots' shares of its machine's memory."""
    containers: int = 0

    @property
    def cpu(self) -> float:
        """Cores."""
        return self.micro_cores / _MICRO

    def memory_of(self, share: int) -> int:
        """Return the bytes on a machine where a slot has this share of the memory."""
        return self.memory + share * self.slots_without_memory

    def add(self, requested: Resources, sign: int = 1) -> None:
        """Count a container; with ``sign`` -1, count it no longer."""
        slots = max(1, requested.size)
        self.slots += sign * slots
        self.micro_cores += sign * round(requested.cpu * _MICRO)
        if requested.memory:
            self.memory += sign * requested.memory
        else:
            self.slots_without_memory += sign * slots
        self.containers += sign


class Promises:
    """Sums by key; a key without containers has none."""

    def __init__(self) -> None:
        self._sums: dict[str, Promise] = {}

    def sum_of(self, key: str) -> Promise:
        """Return a copy of a sum."""
        found = self._sums.get(key)
        return replace(found) if found is not None else Promise()

    def add(self, key: str, requested: Resources) -> None:
        """Count a container."""
        found = self._sums.get(key)
        if found is None:
            found = self._sums[key] = Promise()
        found.add(requested)

    def remove(self, key: str, requested: Resources) -> None:
        """Count a container no longer."""
        found = self._sums[key]
        found.add(requested, -1)
        if not found.containers:
            del self._sums[key]

    @property
    def sums(self) -> dict[str, Promise]:
        """All sums, to compare them."""
        return dict(self._sums)
