"""Driving a robot by hand: what stops it when a key is released, or something is missing or late. Pure."""

from __future__ import annotations

from collections import deque
from math import isfinite
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

DEAD_S = 0.4
"""Without a frame for this time the robot stops."""
LATE_S = 0.35
"""A frame that took this much longer than the fastest one stops the robot."""
ROUND_TRIP_S = 0.6
"""A round trip from the page, to the station or on to the robot, that is longer than this stops the robot."""
WINDOW = 200
"""Frames of which the fastest one is known."""
MAX_SPEED = 0.5
"""Metres per second."""
MAX_TURN_RATE = 1.2
"""Radians per second."""


class DriveFrame(BaseModel):
    """A frame of the page; it sends ten or more in a second while an operator drives."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    number: Annotated[int, Field(ge=0, le=1 << 53)]
    sent: Annotated[float, Field(description="The page's clock, seconds.")]
    held: Annotated[bool, Field(description="Whether the operator holds the dead-man's switch.")]
    speed: Annotated[float, Field(description="Metres per second, forward.")] = 0.0
    turn_rate: Annotated[float, Field(description="Radians per second, counter-clockwise.")] = 0.0
    round_trip: Annotated[float, Field(ge=0, description="Of the last answered frame, seconds.")] = 0.0


class RobotRoundTrip:
    """How long a velocity takes from the station to a robot, and its answer back."""

    def __init__(self) -> None:
        self._unanswered: deque[float] = deque()
        """When velocities were sent, the oldest first."""
        self._last: float | None = None

    def sent(self, now: float) -> None:
        """Note that a velocity was sent; seconds of the station's clock."""
        if len(self._unanswered) < WINDOW:
            self._unanswered.append(now)

    def answered(self, sent: float, now: float) -> None:
        """Note the robot's answer to the velocity that was sent at a time; it answers some only."""
        if not (isfinite(sent) and sent <= now):
            return
        while self._unanswered and self._unanswered[0] <= sent:
            self._unanswered.popleft()
        self._last = now - sent

    def seconds(self, now: float) -> float | None:
        """Return the round trip of the last answer, or more if a later one is awaited for longer.

        Returns:
            Seconds; None if the robot has answered nothing yet.
        """
        if self._last is None:
            return None
        return max(self._last, now - self._unanswered[0] if self._unanswered else 0.0)


class DriveGuard:
    """Decides what a robot that is driven by hand does.

    Args:
        robot: The round trip from the station to the robot.

    Attributes:
        reason: Why it stands; empty while it may drive.
    """

    def __init__(self, robot: RobotRoundTrip | None = None) -> None:
        self._robot = robot or RobotRoundTrip()
        self.reason = "waiting for the dead-man's switch"
        self._delays: deque[float] = deque(maxlen=WINDOW)
        self._number = -1
        self._at = float("-inf")

    def take(self, frame: DriveFrame, now: float, why_not: str = "") -> tuple[float, float]:
        """Handle a frame; return the speed and the turn rate to send, metres and radians per second.

        Args:
            frame: The frame.
            now: The station's clock, seconds.
            why_not: Why the robot must stand, whatever the frame says; empty: it may drive.
        """
        if frame.number <= self._number:
            return self._stand("a frame came out of order")
        self._number, self._at = frame.number, now
        delay = now - frame.sent
        self._delays.append(delay)
        on_to_robot = self._robot.seconds(now) or 0.0
        self.reason = self._why_stand(frame, delay - min(self._delays), why_not, on_to_robot)
        if self.reason:
            return 0.0, 0.0
        return _clip(frame.speed, MAX_SPEED), _clip(frame.turn_rate, MAX_TURN_RATE)

    @staticmethod
    def _why_stand(frame: DriveFrame, late: float, why_not: str, on_to_robot: float) -> str:
        if late > LATE_S:
            return "frames are late"
        if why_not:
            return why_not
        round_trip = frame.round_trip + on_to_robot
        if round_trip > ROUND_TRIP_S:
            return f"a round trip {'to the robot ' if on_to_robot else ''}takes {round_trip:.1f} s"
        if not frame.held:
            return "the dead-man's switch is released"
        if not (isfinite(frame.speed) and isfinite(frame.turn_rate)):
            return "the frame has no velocity"
        return ""

    def check(self, now: float) -> bool:
        """Return whether the robot must stop: no frame came for :data:`DEAD_S`, or it does not answer."""
        if now - self._at >= DEAD_S:
            self._stand("no frame came")
            return True
        return (self._robot.seconds(now) or 0.0) > ROUND_TRIP_S

    def _stand(self, reason: str) -> tuple[float, float]:
        self.reason = reason
        return 0.0, 0.0


def _clip(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
