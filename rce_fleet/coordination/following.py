"""Orders the planner's changes, and detects missing ones. Pure.

Changes are numbered (``fleet/FleetChanges``) and are applied to a complete state (``fleet/GetState``). If a
number is missing, or the planner was restarted, the complete state is needed again; changes that arrive
before it are kept.
"""

from __future__ import annotations

from collections import deque
from typing import Any

MOST_EARLY = 256
"""Changes to keep while the complete state is requested; with more, it is requested again."""

_CONTENT = (
    *("robots", "removed", "blocked", "pending", "freed"),
    *("zones", "removed_zones", "blocks", "removed_blocks"),
)


class ChangeFollower:
    """Follows the changes of a planner. Messages are in their JSON form.

    Attributes:
        is_behind: Whether the complete state is needed.
        follows: Whether changes are followed: a complete state with a number arrived.
    """

    def __init__(self) -> None:
        self.is_behind = True
        self.follows = False
        self._started: Any = None
        self._sequence = 0
        self._early: deque[dict[str, Any]] = deque(maxlen=MOST_EARLY)

    def take_snapshot(self, answer: dict[str, Any]) -> list[dict[str, Any]]:
        """Handle a ``fleet/GetState`` response; return the kept changes that follow it."""
        early = [message for message in self._early if message["started"] == answer["state"]["started"]]
        self._early.clear()
        self.is_behind, self.follows = False, True
        self._started, self._sequence = answer["state"]["started"], int(answer["sequence"])
        return [message for message in early if self._is_next(message)]

    def take_changes(self, message: dict[str, Any]) -> bool:
        """Handle a ``fleet/FleetChanges``; return whether to apply it now."""
        if self.is_behind:
            self._early.append(message)
            return False
        return self._is_next(message)

    def lose(self) -> None:
        """Note that changes may have been missed."""
        self.is_behind = True

    def fall_back(self) -> None:
        """Note that the planner does not answer: complete states are taken as they come until it does."""
        self.is_behind, self.follows = True, False

    def _is_next(self, message: dict[str, Any]) -> bool:
        if self.is_behind:
            self._early.append(message)
            return False
        number = int(message["sequence"])
        if message["started"] == self._started and number <= self._sequence:
            return False  # Known already, or it repeats the last number.
        is_next = number == self._sequence + 1 and any(message.get(part) for part in _CONTENT)
        if message["started"] == self._started and is_next:
            self._sequence = number
            return True
        self.is_behind = True
        self._early.append(message)
        return False
