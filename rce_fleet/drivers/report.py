"""The state of the simulated world: the file that the simulation program writes."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

from pydantic import BaseModel, ValidationError

if TYPE_CHECKING:
    from pathlib import Path

    from rce_fleet.simulation.world import World


class Contacts(BaseModel):
    """Number of collisions by what collided."""

    robot_robot: int
    robot_box: int
    robot_wall: int
    total: int
    robot_door: int = 0
    robot_walker: int = 0
    own_motion: int = 0
    """Those of the total in which a robot drove against the other thing."""


class RobotTruth(BaseModel):
    """True state of a robot."""

    id: str
    cell: int | None
    """None outside the map."""
    x: float
    """Metres."""
    y: float
    yaw: float
    """Radians."""
    distance_m: float
    """Distance driven so far."""


class ContactTruth(BaseModel):
    """A contact of a light robot with another robot."""

    time_s: float
    """Simulated time."""
    robots: tuple[str, str]
    """The second is empty if it is not a light robot."""
    cell: int | None
    """Where the first one was."""


class WorldReport(BaseModel):
    """The world at one time, and all collisions until then."""

    time_s: float
    """Simulated time."""
    collisions: Contacts
    min_separation_m: float | None
    """Smallest distance between the hulls of two robots so far; None with fewer than two robots."""
    boxes: list[int]
    robots: list[RobotTruth]
    contacts: list[ContactTruth] = []
    """The first contacts of light robots."""

    def robot(self, robot: str) -> RobotTruth:
        """Return a robot by id; raise KeyError if it does not exist."""
        for known in self.robots:
            if known.id == robot:
                return known
        raise KeyError(robot)


def look_at(world: World) -> WorldReport:
    """Return the report of a world."""
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
    robots += _light_robots(world)
    return WorldReport(
        time_s=round(world.time, 3),
        collisions=Contacts(
            robot_robot=seen.robot_robot,
            robot_box=seen.robot_box,
            robot_wall=seen.robot_wall,
            total=seen.total,
            robot_door=seen.robot_door,
            robot_walker=seen.robot_walker,
            own_motion=seen.own_motion,
        ),
        min_separation_m=round(apart, 4) if math.isfinite(apart) else None,
        boxes=list(world.boxes),
        robots=robots,
        contacts=_contacts(world),
    )


def _contacts(world: World) -> list[ContactTruth]:
    known = [] if world.light is None else world.light.contacts
    return [
        ContactTruth(
            time_s=round(contact.time, 2),
            robots=(contact.robot, contact.other),
            cell=world.grid.cell_at(contact.x, contact.y),
        )
        for contact in known
    ]


def _light_robots(world: World) -> list[RobotTruth]:
    light = world.light
    if light is None:
        return []
    found = []
    for row, name in light.present_names.items():
        pose = light.pose(row)
        found.append(
            RobotTruth(
                id=name,
                cell=world.grid.cell_at(pose.x, pose.y),
                x=round(pose.x, 4),
                y=round(pose.y, 4),
                yaw=round(pose.yaw, 4),
                distance_m=round(float(light.bodies.distances[row]), 3),
            )
        )
    return found


def write_report(report: WorldReport, path: Path) -> None:
    """Write a report atomically: readers see the old file or the new one."""
    draft = path.with_name(f".{path.name}.draft")
    draft.write_text(json.dumps(report.model_dump(), indent=1) + "\n", encoding="utf-8")
    draft.replace(path)


def read_report(path: Path) -> WorldReport | None:
    """Read a report; return None if the file does not exist yet.

    Raises:
        ValueError: The file is not a report.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    try:
        return WorldReport.model_validate_json(text)
    except ValidationError as error:
        raise ValueError(f"{path} is not a report of the simulation: {error}") from error
