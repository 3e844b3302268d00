"""What truly happened in the world: the file that the simulation program writes."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

from pydantic import BaseModel, ValidationError

if TYPE_CHECKING:
    from pathlib import Path

    from rce_fleet.simulation.world import World


class Contacts(BaseModel):
    """How often something touched something."""

    robot_robot: int
    robot_box: int
    robot_wall: int
    total: int


class RobotTruth(BaseModel):
    """Where a robot truly is."""

    id: str
    cell: int | None
    """None outside of the map."""
    x: float
    """Metres."""
    y: float
    yaw: float
    """Radians."""
    distance_m: float
    """Way driven so far."""


class WorldReport(BaseModel):
    """The world at one moment, and what happened until then."""

    time_s: float
    """Simulated time."""
    collisions: Contacts
    min_separation_m: float | None
    """Smallest distance between the hulls of two robots so far; None with fewer than two robots."""
    boxes: list[int]
    robots: list[RobotTruth]

    def robot(self, robot: str) -> RobotTruth:
        """One robot; KeyError if there is none of that id."""
        for known in self.robots:
            if known.id == robot:
                return known
        raise KeyError(robot)


def look_at(world: World) -> WorldReport:
    """Report on a world as it is now."""
    seen, apart = world.collisions, world.min_separation
    robots = []
    for robot in world.robots.values():
        pose = robot.pose
        robots.append(
            RobotTruth(
                id=robot.id,
                cell=world.grid.cell_at(pose.x, pose.y),
                x=round(pose.x, 4),
                y=round(pose.y, 4),
                yaw=round(pose.yaw, 4),
                distance_m=round(robot.distance, 3),
            )
        )
    return WorldReport(
        time_s=round(world.time, 3),
        collisions=Contacts(
            robot_robot=seen.robot_robot,
            robot_box=seen.robot_box,
            robot_wall=seen.robot_wall,
            total=seen.total,
        ),
        min_separation_m=round(apart, 4) if math.isfinite(apart) else None,
        boxes=list(world.boxes),
        robots=robots,
    )


def write_report(report: WorldReport, path: Path) -> None:
    """Write a report so that readers see the old file or the new one, never half of it."""
    draft = path.with_name(f".{path.name}.draft")
    draft.write_text(json.dumps(report.model_dump(), indent=1) + "\n", encoding="utf-8")
    draft.replace(path)


def read_report(path: Path) -> WorldReport | None:
    """Read a report; None if there is none yet.

    Raises:
        ValueError: The file is no report.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    try:
        return WorldReport.model_validate_json(text)
    except ValidationError as error:
        raise ValueError(f"{path} is no report of a world: {error}") from error
