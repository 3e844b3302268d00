"""Says why no robot can do a task, in words for people."""

from __future__ import annotations

from itertools import islice
from math import inf
from typing import TYPE_CHECKING

from rce_fleet.tasks.assignment import misfit
from rce_fleet.tasks.energy import charges, effort_of
from rce_fleet.tasks.order import Action
from rce_fleet.tasks.records import AUTOMATIC

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rce_fleet.tasks.assignment import Assigner, FreeRobot
    from rce_fleet.tasks.facts import RobotFacts
    from rce_fleet.tasks.order import Order
    from rce_fleet.tasks.task import Task
    from rce_fleet.tasks.travel import TravelCosts

MOST_ROBOTS = 20
"""So many robots that fit, the fullest ones, are looked at for ways and batteries."""
MOST_NAMED = 3
"""So many robots are named in a reason."""
MOST_CELLS = 5
"""So many cells are."""


def why_none(
    task: Task, robots: Sequence[FreeRobot], travel: TravelCosts, assigner: Assigner, chargers: Sequence[int]
) -> str:
    """Return why no robot of the fleet can do a task, even if it had nothing else to do; empty if one can.

    Args:
        task: The task.
        robots: Robots in service that it may be for, those with the fullest batteries first.
        travel: Distances.
        assigner: Decides about batteries.
        chargers: Cells with chargers.
    """
    able = (robot for robot in robots if not misfit(task, robot.id, robot.profile))
    fitting = list(islice(able, MOST_ROBOTS))
    if not fitting:
        return _why_no_fit(task, robots)
    if not chargers and any(stop.action is Action.CHARGE and not stop.cells for stop in task.order.stops):
        return "no charger is open for its stop 'charge': set chargers, or free the cell of one"
    lacks = set()
    for robot in fitting:
        lack = _lack(task, robot, travel, assigner, chargers)
        if not lack:
            return ""
        lacks.add(lack)
    whom, battery = task.order.robot or "any robot", "no robot's battery"
    if next(able, None) is not None:  # another one may do it later
        whom, battery = f"any of {MOST_ROBOTS} robots", f"none of the {MOST_ROBOTS} fullest batteries"
    worst = next(lack for lack in ("energy", "capacity", "charger", "path") if lack in lacks)
    if worst == "path":
        stop = max(_unreached(task, robot, travel) for robot in fitting)
        return f"no path leads {whom} to its {_place(task.order, stop)}"
    when = "it waits until one has charged" if chargers else "no charger is open"
    return {
        "charger": f"no path leads from its last stop to a charger ({_cells(chargers)})",
        "capacity": f"{battery} is large enough for it, even when it is full; split the task",
        "energy": f"{battery} has enough energy for it now; {when}",
    }[worst]


def why_none_drives(robots: Iterable[RobotFacts]) -> str:
    """Return why the planner drives none of some robots now; empty if it drives one.

    Args:
        robots: Robots that could do a task; no more of them are taken than up to one that is driven.
    """
    standing = []
    for robot in robots:
        if robot.is_driven:
            return ""
        standing.append(robot)
    if not standing:
        return ""
    said = [f"{robot.id} is {_how(robot)}{robot.reason and f' ({robot.reason})'}" for robot in standing]
    more = f", and {len(said) - MOST_NAMED} more" if len(said) > MOST_NAMED else ""
    return f"no robot that could do it can be sent now: {', '.join(said[:MOST_NAMED])}{more}"


def _how(robot: RobotFacts) -> str:
    return robot.state if robot.mode == AUTOMATIC else robot.mode.replace("_", " ")


def _lack(
    task: Task, robot: FreeRobot, travel: TravelCosts, assigner: Assigner, chargers: Sequence[int]
) -> str:
    """Return what a robot lacks for a task: a path, a charger, capacity or energy; empty: nothing."""
    effort = effort_of(task, robot.cell, travel, robot.profile, in_metres=True)
    if effort.first == inf:
        return "path"
    if robot.battery is None or charges(task):
        return ""
    needed = assigner.battery_needed(robot.profile, effort, chargers)
    if needed == inf:
        return "charger"
    return "capacity" if needed > 1 else "energy" if robot.battery < needed else ""


def _unreached(task: Task, robot: FreeRobot, travel: TravelCosts) -> int:
    """Return the number of the first stop that a robot does not reach from the one before; or the last."""
    order, here = task.order, robot.cell
    for number in range(task.position, order.length):
        if cells := order.stop(number).cells:
            cell = travel.nearest(here, cells, robot.profile.zone_cost)
            if cell is None:
                return number
            here = cell
    return order.length - 1


def _place(order: Order, number: int) -> str:
    stop = order.stop(number)
    return f"stop {number % len(order.stops) + 1} ({stop.action.value}, {_cells(stop.cells)})"


def _cells(cells: Sequence[int]) -> str:
    more = f" and {len(cells) - MOST_CELLS} more" if len(cells) > MOST_CELLS else ""
    return f"cell{'s'[: len(cells) > 1]} {', '.join(map(str, cells[:MOST_CELLS]))}{more}"


def _why_no_fit(task: Task, robots: Sequence[FreeRobot]) -> str:
    order = task.order
    if order.robot and order.robot not in {robot.id for robot in robots}:
        return f"only {order.robot} may do it, which is not in service"
    asked = [robot for robot in robots if order.robot in ("", robot.id)]
    able = [robot for robot in asked if set(order.capabilities) <= set(robot.profile.capabilities)]
    whom = order.robot or "no robot"
    if not able:
        lacks = "lacks" if order.robot else "has all of"
        return f"{whom} {lacks} the capabilities {', '.join(order.capabilities)}"
    best = max(able, key=lambda robot: robot.profile.payload)
    return (
        f"no robot that may do it carries {order.payload:g} kg: the strongest, {best.id},"
        f" carries {best.profile.payload:g} kg"
    )
