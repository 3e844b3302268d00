"""The station's view of the fleet: a pure model, updated with messages in their JSON form."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import atan2
from typing import Any

ROBOT_RADIUS = 0.22
"""Radius of the robots as the page draws them, metres."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of a robot in the map frame: metres, radians, counter-clockwise from x."""

    x: float
    y: float
    theta: float

    @classmethod
    def of_message(cls, message: dict[str, Any]) -> Pose:
        """Read a geometry_msgs/PoseWithCovarianceStamped in its JSON form."""
        pose = message["pose"]["pose"]
        position, turn = pose["position"], pose["orientation"]
        yaw = atan2(
            2.0 * (turn["w"] * turn["z"] + turn["x"] * turn["y"]),
            1.0 - 2.0 * (turn["y"] ** 2 + turn["z"] ** 2),
        )
        return cls(position["x"], position["y"], yaw)


@dataclass(slots=True)
class FleetView:
    """The newest state of the fleet and the newest pose of each robot."""

    state: dict[str, Any] | None = None
    """The newest ``fleet/FleetState``, or None before the first one."""
    poses: dict[str, Pose] = field(default_factory=dict)

    def on_state(self, message: dict[str, Any]) -> None:
        """Set the state; drop poses of robots that are not in it any more."""
        self.state = message
        present = set(self.robot_ids())
        for robot in [robot for robot in self.poses if robot not in present]:
            del self.poses[robot]

    def on_pose(self, robot: str, message: dict[str, Any]) -> None:
        """Set a robot's pose."""
        self.poses[robot] = Pose.of_message(message)

    def robot_ids(self) -> list[str]:
        """Return the ids of the robots that the planner knows."""
        return [] if self.state is None else [robot["id"] for robot in self.state["robots"]]

    def map(self) -> dict[str, Any] | None:
        """Return the grid in the form of page and API."""
        if self.state is None:
            return None
        return {
            "rows": self.state["rows"],
            "columns": self.state["columns"],
            "cell_size": self.state["cell_size"],
            "origin": [self.state["origin_x"], self.state["origin_y"]],
            "robot_radius": ROBOT_RADIUS,
            "walls": list(self.state["walls"]),
        }

    def robots(self) -> list[dict[str, Any]]:
        """Return the robots, with their poses if known."""
        return [] if self.state is None else [self._robot(robot) for robot in self.state["robots"]]

    def _robot(self, robot: dict[str, Any]) -> dict[str, Any]:
        pose = self.poses.get(robot["id"])
        return {
            **robot,
            "cell": _cell(robot["cell"]),
            "goal": _cell(robot["goal"]),
            "pose": None if pose is None else {"x": pose.x, "y": pose.y, "theta": pose.theta},
        }

    def blocked(self) -> list[int]:
        """Return the blocked cells."""
        return [] if self.state is None else list(self.state["blocked"])

    def pending(self) -> list[int]:
        """Return the cells that will be blocked once a robot has left them."""
        return [] if self.state is None else list(self.state["pending"])


def _cell(number: int) -> int | None:
    return None if number < 0 else number
