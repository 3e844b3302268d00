"""States of a fleet as the operator station says them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rce_fleet.drivers.report import Contacts, RobotTruth, WorldReport
from rce_fleet.station.api import FleetModel, MapModel, RobotModel


def robot(
    name: str,
    *,
    cell: int | None = None,
    goal: int | None = None,
    plan: list[int] | None = None,
    granted: list[int] | None = None,
    state: str = "idle",
    replans: int = 0,
) -> RobotModel:
    """A robot; its plan is its cell, and the first cell of its plan is granted, if nothing else is given."""
    if plan is None:
        plan = [] if cell is None else [cell]
    return RobotModel(
        id=name,
        state=state,
        reason="",
        cell=cell,
        goal=goal,
        plan=plan,
        granted=plan[:1] if granted is None else granted,
        replans=replans,
        pose=None,
    )


def fleet(
    *robots: RobotModel, blocked: Sequence[int] = (), pending: Sequence[int] = (), size: int = 4
) -> FleetModel:
    floor = MapModel(rows=size, columns=size, cell_size=1.0, origin=(0, 0), robot_radius=0.22, walls=[])
    return FleetModel(map=floor, robots=list(robots), blocked=list(blocked), pending=list(pending))


def truth(
    cells: Mapping[str, int], *, boxes: Sequence[int] = (), collisions: int = 0, apart: float | None = None
) -> WorldReport:
    """A world in which robots stand in ``cells`` and have driven a metre each."""
    contacts = Contacts(robot_robot=collisions, robot_box=0, robot_wall=0, total=collisions)
    robots = [
        RobotTruth(id=name, cell=cell, x=0.0, y=0.0, yaw=0.0, distance_m=1.0) for name, cell in cells.items()
    ]
    return WorldReport(
        time_s=1.0, collisions=contacts, min_separation_m=apart, boxes=list(boxes), robots=robots
    )
