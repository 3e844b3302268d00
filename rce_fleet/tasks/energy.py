"""What a task takes out of a battery, and whether a battery is enough for it."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite
from typing import TYPE_CHECKING, NamedTuple

from rce_fleet.tasks.order import Action

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_fleet.tasks.records import RobotProfile
    from rce_fleet.tasks.task import Task
    from rce_fleet.tasks.travel import TravelCosts

_SECONDS_PER_HOUR = 3600.0


@dataclass(frozen=True, slots=True)
class BatteryLevels:
    """Four thresholds, shares of the full battery 0 .. 1, as openTCS has them.

    Attributes:
        critical: Below it a robot gets no task, and goes to charge; no task may bring it below.
        good: An idle robot below it charges.
        sufficient: A robot that charges may be given a task from here on.
        full: It leaves the charger.
    """

    critical: float = 0.15
    good: float = 0.5
    sufficient: float = 0.4
    full: float = 0.95

    def __post_init__(self) -> None:
        if not 0 <= self.critical < self.sufficient <= self.full <= 1:
            raise ValueError(
                "battery levels must be 0 <= critical < sufficient <= full <= 1, not"
                f" {self.critical}, {self.sufficient}, {self.full}"
            )
        if not self.critical <= self.good <= self.full:
            raise ValueError(f"the level good must be within {self.critical} .. {self.full}, not {self.good}")


class Effort(NamedTuple):
    """What the rest of a task costs a robot.

    Attributes:
        first: Metres to the first stop; ``inf``: no way leads there.
        metres: Metres of the ways after that.
        acting: Seconds of actions.
        end: Cell of the last stop.
    """

    first: float
    metres: float
    acting: float
    end: int | None

    def seconds(self, profile: RobotProfile) -> float:
        """Return how long it takes, seconds."""
        return (self.first + self.metres) / profile.speed + self.acting


def driven(zone_cost: Mapping[str, float]) -> dict[str, float]:
    """Return of zones' costs those that change what a robot drives: cells or moves are closed to it.

    Other costs only choose robots and ways: a metre takes as much out of the battery as elsewhere. Detours
    that robots make around such zones are not counted.
    """
    return {name: factor for name, factor in zone_cost.items() if not isfinite(factor)}


def effort_of(
    task: Task, start: int, travel: TravelCosts, profile: RobotProfile, *, in_metres: bool = False
) -> Effort:
    """Return what the rest of a task costs a robot that stands in a cell.

    Each stop is made in the one of its cells that is nearest to the stop before. Stops without cells, at any
    charger or parking place, count nothing.

    Args:
        task: The task.
        start: Where the robot stands.
        travel: Distances.
        profile: The robot's.
        in_metres: Return the metres that are driven, as batteries need them, not what they count in zones.
    """
    here, first, metres, acting = start, 0.0, 0.0, 0.0
    zones = profile.zone_cost
    counted = driven(zones) if in_metres else zones
    is_first = True
    order = task.order
    for number in range(task.position, order.length):
        stop = order.stop(number)
        acting += stop.duration
        if not stop.cells:
            continue
        cell = stop.cells[0] if len(stop.cells) == 1 else travel.nearest(here, stop.cells, zones)
        way = inf if cell is None else travel.metres(here, cell, counted)
        if way == inf or cell is None:
            return Effort(inf, inf, acting, None)
        if is_first:
            first, is_first = way, False
        else:
            metres += way
        here = cell
    return Effort(first, metres, acting, here)


def share_needed(effort: Effort, profile: RobotProfile, to_charger: float = 0.0) -> float:
    """Return the share of a full battery that a task takes, with the way to a charger after it.

    Args:
        effort: The task's, with metres as they are driven.
        profile: The robot's.
        to_charger: Metres from the last stop to the nearest charger; infinite: no way leads there.
    """
    metres = effort.first + effort.metres + to_charger
    if metres == inf:
        return inf  # a robot that takes nothing while it stands would need inf * 0
    seconds = metres / profile.speed + effort.acting
    drawn = metres * profile.drive
    drawn += (seconds * profile.idle + effort.acting * profile.acting) / _SECONDS_PER_HOUR
    return drawn / profile.capacity


def seconds_to_fill(task: Task, battery: float | None, profile: RobotProfile, full: float) -> float:
    """Return how long a robot charges at the next stop of a task that charges until the battery is full.

    Args:
        task: The task.
        battery: Share of the full battery now; None: not known.
        profile: The robot's.
        full: Share with which it leaves the charger.

    Returns:
        Seconds, 0 without such a stop; ``inf``: the charger gives no more than the robot takes.
    """
    left = (task.order.stop(number) for number in range(task.position, task.order.length))
    if battery is None or not any(stop.action is Action.CHARGE and not stop.duration for stop in left):
        return 0.0
    lacking, watts = max(0.0, full - battery) * profile.capacity, profile.charging - profile.idle
    return lacking / watts * _SECONDS_PER_HOUR if watts > 0 else inf if lacking else 0.0


def charges(task: Task) -> bool:
    """Return whether the next stop of a task charges: the battery need not be enough for the rest."""
    stop = task.next_stop
    return stop is not None and stop.action is Action.CHARGE
