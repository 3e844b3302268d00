"""The station's view of the fleet: a pure model, updated with messages in their JSON form."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

from rce_fleet.geometry.angles import yaw_of
from rce_fleet.station.cell_blocks import Block, is_same, read_block

ROBOT_RADIUS = 0.22
"""Radius of the robots as the page draws them, metres."""

_MAP = ("rows", "columns", "cell_size", "origin_x", "origin_y", "walls")


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
        return cls(position["x"], position["y"], yaw_of(*(turn[axis] for axis in "xyzw")))


@dataclass(frozen=True, slots=True)
class ViewChange:
    """A change of the view by a message.

    Attributes:
        is_new_map: Whether the map changed.
        is_new_mode: Whether the fleet was paused, stopped or resumed.
        robots: Ids of robots that are new or changed.
        removed: Ids of removed robots.
        blocked: Cells that became blocked, ascending.
        pending: Cells that will be blocked once a robot has left them, ascending.
        freed: Cells that are not blocked or pending any more, ascending.
        blocks: Cells that a person or a sensor blocked, or of which who or why changed, ascending.
        removed_blocks: Cells that neither blocks any more, ascending.
    """

    is_new_map: bool = False
    is_new_mode: bool = False
    robots: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    blocked: tuple[int, ...] = ()
    pending: tuple[int, ...] = ()
    freed: tuple[int, ...] = ()
    blocks: tuple[int, ...] = ()
    removed_blocks: tuple[int, ...] = ()

    def __bool__(self) -> bool:
        return self != _NOTHING


_NOTHING = ViewChange()


@dataclass(slots=True)
class FleetView:
    """The newest state of the fleet and the newest pose of each robot."""

    poses: dict[str, Pose] = field(default_factory=dict)
    heard_at: dict[str, float] = field(default_factory=dict)
    """When robots gave their last signs of life, as the planner told with poses; monotonic seconds."""
    planner_heard_at: float | None = None
    """When the planner was heard last, monotonic seconds; None: never."""
    mode: str = "automatic"
    """The mode of the fleet: automatic, paused or stopped."""
    planner_run: str = ""
    """When the planner of the newest complete state was started, as it says."""
    _yaw: float = 0.0
    """Direction of the grid's columns, radians; it is in no ``fleet/FleetState``."""
    _map: dict[str, Any] | None = None
    _robots: dict[str, dict[str, Any]] = field(default_factory=dict)
    _blocked: set[int] = field(default_factory=set)
    _pending: set[int] = field(default_factory=set)
    _blocks: dict[int, Block] = field(default_factory=dict)

    @property
    def state(self) -> dict[str, Any] | None:
        """Robots and cells as in a ``fleet/FleetState``; None before the first one."""
        if self._map is None:
            return None
        return {
            **self._map,
            "robots": [self._robots[robot] for robot in self.robot_ids()],
            "blocked": self.blocked(),
            "pending": self.pending(),
        }

    def on_state(self, message: dict[str, Any], now: float = 0.0) -> ViewChange:
        """Set the complete state, which came ``now`` (seconds since 1970); remove what is not in it."""
        grid = {key: message[key] for key in _MAP}
        grid["lanes"] = message.get("lanes", [])  # planners of earlier releases tell none
        robots = {robot["id"]: robot for robot in message["robots"]}
        blocked, pending = set(message["blocked"]), set(message["pending"])
        told = message.get("blocks", ())  # planners of earlier releases tell none
        blocks = {block["cell"]: read_block(block, now) for block in told}
        new_blocks = {cell for cell, block in blocks.items() if not is_same(block, self._blocks.get(cell))}
        change = ViewChange(
            is_new_map=grid != self._map,
            is_new_mode=self._set_mode(message),
            robots=tuple(sorted(robot for robot in robots if robots[robot] != self._robots.get(robot))),
            removed=tuple(sorted(self._robots.keys() - robots.keys())),
            blocked=_ascending(blocked - self._blocked),
            pending=_ascending(pending - self._pending),
            freed=_ascending((self._blocked | self._pending) - blocked - pending),
            blocks=tuple(sorted(new_blocks)),
            removed_blocks=tuple(sorted(self._blocks.keys() - blocks.keys())),
        )
        self._blocks = {cell: blocks[cell] if cell in new_blocks else self._blocks[cell] for cell in blocks}
        self.planner_run = message.get("started", "")
        self._map, self._robots, self._blocked, self._pending = grid, robots, blocked, pending
        for robot in self.poses.keys() - robots.keys():
            del self.poses[robot]
            self.heard_at.pop(robot, None)
        return change

    def on_grid(self, message: dict[str, Any]) -> ViewChange:
        """Set the grid's rotation from a ``nav_msgs/OccupancyGrid`` of ``/fleet/map``."""
        turn = message["info"]["origin"]["orientation"]
        yaw = yaw_of(*(turn[axis] for axis in "xyzw"))
        if yaw == self._yaw or not isfinite(yaw):
            return _NOTHING
        self._yaw = yaw
        return ViewChange(is_new_map=self._map is not None)

    def on_changes(self, message: dict[str, Any], now: float = 0.0) -> ViewChange:
        """Apply a ``fleet/FleetChanges`` that follows the known state, and came ``now`` (s since 1970)."""
        for robot in message["robots"]:
            self._robots[robot["id"]] = robot
        for name in message["removed"]:
            self._robots.pop(name, None)
            self.poses.pop(name, None)
            self.heard_at.pop(name, None)
        blocked, pending, freed = (set(message[part]) for part in ("blocked", "pending", "freed"))
        self._blocked = (self._blocked | blocked) - pending - freed
        self._pending = (self._pending | pending) - blocked - freed
        blocks = {block["cell"]: read_block(block, now) for block in message.get("blocks", ())}
        removed_blocks = tuple(message.get("removed_blocks", ()))
        for cell in removed_blocks:
            self._blocks.pop(cell, None)
        self._blocks |= blocks
        return ViewChange(
            is_new_mode=self._set_mode(message),
            robots=tuple(sorted(robot["id"] for robot in message["robots"])),
            removed=tuple(message["removed"]),
            blocked=_ascending(blocked),
            pending=_ascending(pending),
            freed=_ascending(freed),
            blocks=tuple(sorted(blocks)),
            removed_blocks=removed_blocks,
        )

    def _set_mode(self, message: dict[str, Any]) -> bool:
        """Set the mode of the fleet; return whether it is another one. Earlier planners tell none."""
        before, self.mode = self.mode, message.get("mode") or "automatic"
        return self.mode != before

    def on_pose(self, robot: str, message: dict[str, Any]) -> None:
        """Set a robot's pose."""
        self.poses[robot] = Pose.of_message(message)

    def on_poses(self, message: dict[str, Any], now: float) -> list[str]:
        """Set the poses of a ``fleet/FleetPoses`` that came ``now``; return the robots that are known."""
        columns = (message[name] for name in ("robots", "x", "y", "yaw"))
        ages = message.get("age", ())  # planners of earlier releases tell none
        known = []
        for place, (robot, x, y, yaw) in enumerate(zip(*columns, strict=False)):
            if robot in self._robots:
                self.poses[robot] = Pose(x, y, yaw)
                if place < len(ages):
                    self.heard_at[robot] = now - ages[place]
                known.append(robot)
        return known

    def age(self, robot: str, now: float) -> float | None:
        """Return the seconds since a robot's last sign of life; None: the planner does not tell."""
        heard_at = self.heard_at.get(robot)
        return None if heard_at is None else max(0.0, now - heard_at)

    def planner_age(self, now: float) -> float | None:
        """Return the seconds since the planner was heard last; None: it never was."""
        return None if self.planner_heard_at is None else max(0.0, now - self.planner_heard_at)

    def robot_ids(self) -> list[str]:
        """Return the ids of the robots that the planner knows, ascending."""
        return sorted(self._robots)

    def knows(self, robot: str) -> bool:
        """Return whether the planner knows a robot."""
        return robot in self._robots

    def state_of(self, robot: str) -> str:
        """Return the state of a robot, such as ``driving``; empty: it is not known."""
        return str(self._robots.get(robot, {}).get("state", ""))

    def mode_of(self, robot: str) -> str:
        """Return the mode that counts for a robot, of its own and the fleet's; empty: not known."""
        return str(self._robots.get(robot, {}).get("mode", ""))

    def own_mode_of(self, robot: str) -> str:
        """Return a robot's own mode. Under a fleet that is paused or stopped it is taken for automatic."""
        mode = self.mode_of(robot)
        return "automatic" if mode in ("", "lost", self.mode) else mode

    def map(self) -> dict[str, Any] | None:
        """Return the grid in the form of page and API."""
        if self._map is None:
            return None
        return {
            "rows": self._map["rows"],
            "columns": self._map["columns"],
            "cell_size": self._map["cell_size"],
            "origin": [self._map["origin_x"], self._map["origin_y"]],
            "yaw": self._yaw,
            "robot_radius": ROBOT_RADIUS,
            "walls": list(self._map["walls"]),
            "lanes": list(self._map["lanes"]),
        }

    def robots(self, names: Iterable[str] | None = None) -> list[dict[str, Any]]:
        """Return robots, with their poses if known.

        Args:
            names: Ids of the robots; all, ascending, if None. Unknown ones are left out.
        """
        wanted = self.robot_ids() if names is None else names
        return [self._robot(self._robots[robot]) for robot in wanted if robot in self._robots]

    def _robot(self, robot: dict[str, Any]) -> dict[str, Any]:
        pose = self.poses.get(robot["id"])
        return {
            **robot,
            "cell": _cell(robot["cell"]),
            "goal": _cell(robot["goal"]),
            "pose": None if pose is None else {"x": pose.x, "y": pose.y, "theta": pose.theta},
        }

    def blocked(self) -> list[int]:
        """Return the blocked cells, ascending."""
        return sorted(self._blocked)

    def pending(self) -> list[int]:
        """Return the cells that will be blocked once a robot has left them, ascending."""
        return sorted(self._pending)

    def blocks(self, cells: Iterable[int] | None = None) -> list[Block]:
        """Return who blocked cells, and why.

        Args:
            cells: The cells; all that a person or a sensor blocked, ascending, if None.
        """
        wanted = sorted(self._blocks) if cells is None else cells
        return [self._blocks[cell] for cell in wanted if cell in self._blocks]


def _ascending(cells: set[int]) -> tuple[int, ...]:
    return tuple(sorted(cells))


def _cell(number: int) -> int | None:
    return None if number < 0 else number
