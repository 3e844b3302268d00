"""Names of goals. Pure, but for a counter."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING, Any

from rce.ros.types.values import NANOSECONDS, Time

if TYPE_CHECKING:
    from rce.ros.types import Message

_counter = count(1)


@dataclass(frozen=True, slots=True)
class GoalId:
    """The contents of an ``actionlib_msgs/GoalID``.

    Attributes:
        id: Unique in the graph; empty where all goals are meant, or where the server is to choose one.
        stamp: When the goal was made, nanoseconds; 0: not said.
    """

    id: str = ""
    stamp: int = 0

    @classmethod
    def make(cls, node: str, now: Time) -> GoalId:
        """Make the id of a new goal.

        Args:
            node: Global name of the node that makes it.
            now: The graph's time.
        """
        return cls(f"{node}-{next(_counter)}-{now.to_sec():.3f}", now.to_nsec())

    @classmethod
    def read(cls, message: Message) -> GoalId:
        """Read an ``actionlib_msgs/GoalID``."""
        return cls(message.id, message.stamp.to_nsec())

    @property
    def time(self) -> Time:
        """The stamp as messages carry it."""
        return Time(*divmod(self.stamp, NANOSECONDS))

    @property
    def fields(self) -> dict[str, Any]:
        """The fields of an ``actionlib_msgs/GoalID``."""
        return {"stamp": self.time, "id": self.id}
