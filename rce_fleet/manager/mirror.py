"""Keeps values in the journal and in the planner the same, whichever of the two was changed. Pure.

A value is compared three times: as the journal has it, as the planner has it, and as both had it when they
last agreed. The side that is different from the last agreement was changed, and the other one follows.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

K = TypeVar("K")
V = TypeVar("V")

SETTLE_S = 2.0
"""Seconds after a value was sent in which the planner's state may still be the one before."""
REFUSED_S = 10.0
"""Seconds after which a value that the planner refused is sent again."""


@dataclass(frozen=True, slots=True)
class Differences(Generic[K, V]):
    """What one side has to take over from the other. None: the value is gone.

    Attributes:
        to_send: To the planner.
        to_adopt: Into the journal.
    """

    to_send: dict[K, V | None] = field(default_factory=dict)
    to_adopt: dict[K, V | None] = field(default_factory=dict)


class Mirror(Generic[K, V]):
    """Values by key, of which journal and planner each have a copy.

    Args:
        delay: Seconds by which the planner's values may be late: for so long after the planner accepted a
            value it counts as the planner's. 0: an equal value shows that they are not late.
    """

    def __init__(self, delay: float = 0.0) -> None:
        self._delay = delay
        self._agreed: dict[K, V] = {}
        self._wait_until: dict[K, float] = {}
        self._accepted: dict[K, tuple[V | None, float]] = {}

    def restart(self, agreed: Mapping[K, V]) -> None:
        """Begin anew.

        Args:
            agreed: What both had last: nothing after a restart of the planner, so that it gets everything;
                the journal's values after a restart of the manager only, so that changes at the planner in
                the meantime count.
        """
        self._agreed = dict(agreed)
        self._wait_until.clear()
        self._accepted.clear()

    def forget(self, key: K) -> None:
        """Forget a key that one side does not know now: it gets the journal's value when it does again."""
        self._agreed.pop(key, None)
        self._wait_until.pop(key, None)
        self._accepted.pop(key, None)

    def compare(
        self, kept: Mapping[K, V], seen: Mapping[K, V], now: float, untold: Collection[K] = ()
    ) -> Differences[K, V]:
        """Return what has to be sent to the planner, and what was changed there.

        Args:
            kept: The journal's values.
            seen: The planner's.
            now: Seconds.
            untold: Keys that have to be sent though the values may be equal: their parts that are not
                compared were changed.
        """
        found: Differences[K, V] = Differences()
        self._accepted = {key: value for key, value in self._accepted.items() if now < value[1]}
        for key in {**kept, **seen, **self._agreed}:
            here, there, agreed = kept.get(key), seen.get(key), self._agreed.get(key)
            if key in self._accepted:
                there = self._accepted[key][0]
            if here == there and key not in untold:
                self._agree(key, here)
                self._wait_until.pop(key, None)
            elif now < self._wait_until.get(key, now):
                continue
            elif here == agreed and key not in untold:
                found.to_adopt[key] = there
            else:
                found.to_send[key] = here
        return found

    def sent(self, key: K, value: V | None, now: float, *, refused: bool) -> None:
        """Note that the planner accepted or refused a value."""
        if refused or not self._delay:
            self._wait_until[key] = now + (REFUSED_S if refused else SETTLE_S)
        else:
            self._wait_until.pop(key, None)
            self._accepted[key] = value, now + self._delay
        if not refused:
            self._agree(key, value)

    def is_known(self, key: K, value: V | None) -> bool:
        """Return whether both had this value when they last agreed."""
        return self._agreed.get(key) == value

    def _agree(self, key: K, value: V | None) -> None:
        if value is None:
            self._agreed.pop(key, None)
        else:
            self._agreed[key] = value
