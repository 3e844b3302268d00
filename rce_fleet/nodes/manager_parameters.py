"""The parameters of the fleet manager."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from rce_fleet.limits import LEAST_CAPACITY, LEAST_SPEED, MOST_AMOUNT, MOST_CELL, MOST_SPEED
from rce_fleet.tasks.assignment import AssignmentRules
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.energy import BatteryLevels
from rce_fleet.tasks.progress import ProgressRules
from rce_fleet.tasks.records import RobotProfile

_SHARE = {"minimum": 0.0, "maximum": 1.0}
_POSITIVE = {"above": 0.0}
_CELLS = {"minimum": 0, "maximum": MOST_CELL}
_AMOUNT = {"minimum": 0.0, "maximum": MOST_AMOUNT}
_POWER = {"minimum": LEAST_CAPACITY, "maximum": MOST_AMOUNT}
_LEAST_ZERO = {"minimum": 0.0}
_WEIGHT = {"minimum": 0.0, "maximum": MOST_AMOUNT}


@dataclass(frozen=True)
class BatteryParameters:
    """Thresholds of batteries, shares 0 .. 1.

    Attributes:
        critical: Below it a robot gets no task and charges; no task may bring it below.
        good: An idle robot below it charges.
        sufficient: A robot that charges may be given a task from here on.
        full: It leaves the charger.
    """

    critical: float = field(default=0.15, metadata=_SHARE)
    good: float = field(default=0.5, metadata=_SHARE)
    sufficient: float = field(default=0.4, metadata=_SHARE)
    full: float = field(default=0.95, metadata=_SHARE)


@dataclass(frozen=True)
class RobotParameters:
    """What robots can do that have no profile of their own (PATCH /robots/{id}).

    Attributes:
        capabilities: Names of what they have.
        payload: Most that one carries, kilograms.
        speed: Mean speed, metres per second, turns and waiting included.
        capacity: Energy of the full battery, watt hours.
        drive: Watt hours for each metre.
        idle: Watts of electronics, sensors and computer.
        acting: Watts of an action at a stop, beside ``idle``.
        charging: Watts that a charger gives.
    """

    capabilities: tuple[str, ...] = ()
    payload: float = field(default=5.0, metadata=_AMOUNT)
    speed: float = field(default=0.4, metadata={"minimum": LEAST_SPEED, "maximum": MOST_SPEED})
    capacity: float = field(default=60.0, metadata=_POWER)
    drive: float = field(default=0.012, metadata=_AMOUNT)
    idle: float = field(default=8.0, metadata=_AMOUNT)
    acting: float = field(default=5.0, metadata=_AMOUNT)
    charging: float = field(default=30.0, metadata=_POWER)


@dataclass(frozen=True)
class ManagerParameters:
    """Parameters of the node. Times in seconds.

    Attributes:
        journal: File of the journal, or a folder for it; empty: on the volume ``fleet``, else
            in the container's home.
        chargers: Cells with chargers, until people set others.
        parking: Cells where idle robots wait.
        return_cells: Where loads of cancelled tasks are brought.
        lost_after: A robot that is silent this long gives its task up.
        stuck_after: So does one that has not changed its cell for this long.
        unreachable_after: So does one to whose goal no path has led for this long.
        load_lost_after: A task whose load is on a robot that cannot continue fails after this time.
        queue_length: Most tasks in the queue of a busy robot.
        improve_every: Time from the end of a search for better queues to the next one, if OR-Tools is
            installed; 0: no search.
        park_after: An idle robot goes out of the way after this time.
        energy_weight: What a task costs a robot whose usable energy it takes, seconds of way.
        fairness_weight: What a robot that has worked all the time is dearer than one that has not.
        battery: Thresholds.
        robot: What robots can do.
    """

    journal: str = ""
    chargers: tuple[int, ...] = field(default=(), metadata=_CELLS)
    parking: tuple[int, ...] = field(default=(), metadata=_CELLS)
    return_cells: tuple[int, ...] = field(default=(), metadata=_CELLS)
    lost_after: float = field(default=15.0, metadata=_LEAST_ZERO)
    stuck_after: float = field(default=120.0, metadata=_POSITIVE)
    unreachable_after: float = field(default=20.0, metadata=_LEAST_ZERO)
    load_lost_after: float = field(default=3600.0, metadata=_LEAST_ZERO)
    queue_length: int = field(default=3, metadata=_LEAST_ZERO)
    improve_every: float = field(default=5.0, metadata=_LEAST_ZERO)
    park_after: float = field(default=5.0, metadata=_LEAST_ZERO)
    energy_weight: float = field(default=60.0, metadata=_WEIGHT)
    fairness_weight: float = field(default=30.0, metadata=_WEIGHT)
    battery: BatteryParameters = field(default_factory=BatteryParameters)
    robot: RobotParameters = field(default_factory=RobotParameters)


def rules_of(parameters: ManagerParameters) -> TaskRules:
    """Return the rules that parameters describe.

    Raises:
        ValueError: The thresholds of batteries are out of order.
    """
    battery, robot = parameters.battery, parameters.robot
    return TaskRules(
        progress=ProgressRules(
            lost_after=parameters.lost_after,
            stuck_after=parameters.stuck_after,
            unreachable_after=parameters.unreachable_after,
            load_lost_after=parameters.load_lost_after,
        ),
        assignment=AssignmentRules(energy=parameters.energy_weight, fairness=parameters.fairness_weight),
        battery=BatteryLevels(**{each.name: getattr(battery, each.name) for each in fields(battery)}),
        profile=RobotProfile(**{each.name: getattr(robot, each.name) for each in fields(robot)}),
        queue_length=parameters.queue_length,
        park_after=parameters.park_after,
    )
