"""Puts the planner's changes in order, and notices when one is missing. Pure.

Changes are numbered (``fleet/FleetChanges``). They can be applied to a whole state (``fleet/GetState``) that
holds the change before. When a number is left out, or the planner is another one, the whole state is needed
again; what comes until it is there is kept.
"""

from __future__ import annotations

from collections import deque
from typing import Any

MOST_EARLY = 256
"""Changes that are kept while the whole state is asked for; with more, it is asked for again."""

_CONTENT = ("robots", "removed", "blocked", "pending", "freed")


class ChangeFollower:
    """Follows the changes of a planner. Messages are in their JSON form.

    Attributes:
        is_behind: Whether the whole state is needed.
        follows: Whether a whole state with a number was ever there: the planner tells of changes.
    """

    def __init__(self) -> None:
        self.is_behind = True
        self.follows = False
        self._started: Any = None
        self._sequence = 0
        self._early: deque[dict[str, Any]] = deque(maxlen=MOST_EARLY)

    def take_snapshot(self, answer: dict[str, Any]) -> list[dict[str, Any]]:
        """Take a ``fleet/GetState`` response; returns the changes that came early and follow upon it."""
        early = [message for message in self._early if message["started"] == answer["state"]["started"]]
        self._early.clear()
        self.is_behind, self.follows = False, True
        self._started, self._sequence = answer["state"]["started"], int(answer["sequence"])
        return [message for message in early if self._is_next(message)]

    def take_changes(self, message: dict[str, Any]) -> bool:
        """Take a ``fleet/FleetChanges``; tell whether it is to be applied now."""
        if self.is_behind:
            self._early.append(message)
            return False
        return self._is_next(message)

    def lose(self) -> None:
        """Take note that changes may have been missed."""
        self.is_behind = True

    def _is_next(self, message: dict[str, Any]) -> bool:
        if self.is_behind:
            self._early.append(message)
            return False
        number = int(message["sequence"])
        if message["started"] == self._started and number <= self._sequence:
            return False  # It is known, or repeats the number of the last one.
        is_next = number == self._sequence + 1 and any(message[part] for part in _CONTENT)
        if message["started"] == self._started and is_next:
            self._sequence = number
            return True
        self.is_behind = True
        self._early.append(message)
        return False
