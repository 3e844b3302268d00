"""Chooses tasks for idle robots: all at once, by the cheapest sum of ways."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, nan
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from rce_fleet.tasks.energy import BatteryLevels, Effort, charges, effort_of, share_needed

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from numpy.typing import NDArray

    from rce_fleet.tasks.records import RobotProfile
    from rce_fleet.tasks.task import Task
    from rce_fleet.tasks.travel import TravelCosts

_IMPOSSIBLE = 1e9
_SPARE_TASKS = 50
"""So many tasks more than robots, and twice as many as robots, are looked at, the most urgent ones."""
_ATTEMPTS = 4
"""A step assigns at most so often, if robots turn out to have too little energy for tasks."""


@dataclass(frozen=True, slots=True)
class AssignmentRules:
    """What counts when tasks are chosen. All in seconds of a robot's way.

    Attributes:
        priority: What one step of priority is worth.
        age: What a second of waiting is worth: no task waits without end.
        deadline: What a second less than ``deadline_window`` is worth ...
        deadline_window: ... that is left of the time before the last moment to begin.
        keep: What it is worth to leave a task in the queue of its robot: another one takes it over if it
            is at the first stop so much earlier.
    """

    priority: float = 300.0
    age: float = 0.5
    deadline: float = 2.0
    deadline_window: float = 300.0
    keep: float = 10.0


class FreeRobot(NamedTuple):
    """A robot that can begin with a task: its name, cell, profile and share of a full battery."""

    id: str
    cell: int
    profile: RobotProfile
    battery: float | None


class Choice(NamedTuple):
    """A robot that shall begin with a task."""

    task: Task
    robot: str
    seconds: float


class Assigner:
    """Chooses tasks for robots.

    Args:
        travel: Distances.
        rules: What counts.
        levels: Thresholds of batteries.
    """

    def __init__(self, travel: TravelCosts, rules: AssignmentRules, levels: BatteryLevels) -> None:
        self._travel = travel
        self._rules = rules
        self._levels = levels

    def urgency(self, task: Task, now: float, seconds: float = 0.0) -> float:
        """Return what it is worth to begin with a task now, in seconds of way.

        Args:
            task: The task.
            now: Seconds since 1970.
            seconds: About how long it takes.
        """
        rules = self._rules
        since = max(task.created_at, task.order.earliest_start or 0.0)
        worth = task.order.priority * rules.priority + max(0.0, now - since) * rules.age
        if task.order.deadline is not None:
            left = task.order.deadline - now - seconds
            worth += max(0.0, rules.deadline_window - left) * rules.deadline
        return worth

    def refuse(self, task: Task, robot: FreeRobot, effort: Effort, chargers: Sequence[int]) -> str:
        """Return why a robot cannot do a task; empty if it can."""
        if reason := misfit(task, robot.id, robot.profile):
            return reason
        if effort.first == inf:
            return "no path leads it to all stops"
        return self.lack_of_energy(task, robot, effort, chargers)

    def lack_of_energy(self, task: Task, robot: FreeRobot, effort: Effort, chargers: Sequence[int]) -> str:
        """Return why a robot's battery is not enough for the rest of a task; empty if it is."""
        if robot.battery is not None and not charges(task):
            needed = self.battery_needed(robot.profile, effort, chargers)
            if robot.battery < needed:
                return f"its battery has {robot.battery:.0%}; task and way to a charger need {needed:.0%}"
        return ""

    def battery_needed(self, profile: RobotProfile, effort: Effort, chargers: Sequence[int]) -> float:
        """Return the share of a full battery that a robot must have to begin with a task."""
        ways = [self._travel.metres(effort.end, cell) for cell in chargers if effort.end is not None]
        to_charger = min(ways, default=0.0)
        return share_needed(effort, profile, to_charger) + self._levels.critical

    def choose(
        self,
        tasks: Sequence[Task],
        robots: Sequence[FreeRobot],
        now: float,
        chargers: Sequence[int] = (),
        avoided: Collection[tuple[int, str]] = (),
        begins: Callable[[Task], float] = lambda _task: inf,
    ) -> list[Choice]:
        """Return which robots begin with which tasks, with the smallest sum of costs.

        Args:
            tasks: Tasks that can begin now.
            robots: Robots that can.
            now: Seconds since 1970.
            chargers: Cells with chargers.
            avoided: Numbers of tasks with robots that gave them up a short time ago.
            begins: Returns in how many seconds the robot in whose queue a task is will be at its first stop.
        """
        if not tasks or not robots:
            return []
        groups = [_Group(rows, [robots[row] for row in rows]) for rows in _rows_by_profile(robots)]
        urgent = self._most_urgent(tasks, groups, now)
        costs = np.full((len(robots), len(urgent)), _IMPOSSIBLE)
        ways = np.full_like(costs, inf)
        for group in groups:
            costs[group.rows], ways[group.rows] = self._price(urgent, group, now, chargers)
        names = {robot.id: row for row, robot in enumerate(robots)}
        columns = {task.number: column for column, task in enumerate(urgent)}
        costs[
            [names[name] for number, name in avoided if number in columns and name in names],
            [columns[number] for number, name in avoided if number in columns and name in names],
        ] = _IMPOSSIBLE
        for column, task in enumerate(urgent):
            if not task.robot:
                continue
            later = ways[:, column] + self._rules.keep >= begins(task)
            row = names.get(task.robot)
            if row is not None:
                costs[row, column] -= self._rules.keep
                later[row] = False
            costs[later, column] = _IMPOSSIBLE
        return self._pairs(costs, urgent, robots, chargers)

    def _most_urgent(self, tasks: Sequence[Task], groups: Sequence[_Group], now: float) -> list[Task]:
        """Return the most urgent of the tasks that one of the robots may do."""
        robots = sum(len(group.names) for group in groups)
        most = max(2 * robots, robots + _SPARE_TASKS)
        names = {name: group for group in groups for name in group.names}
        urgent = []
        for task in sorted(tasks, key=lambda task: (-self.urgency(task, now), task.number)):
            only = task.order.robot
            able = ([names[only]] if only in names else []) if only else groups
            if any(not misfit(task, only or group.names[0], group.profile) for group in able):
                urgent.append(task)
                if len(urgent) == most:
                    break
        return urgent

    def _pairs(
        self,
        costs: NDArray[np.float64],
        urgent: Sequence[Task],
        robots: Sequence[FreeRobot],
        chargers: Sequence[int],
    ) -> list[Choice]:
        """Return the cheapest pairs; their batteries are checked again, with the cells of all stops.

        What is refused then is assigned anew among those that are left.
        """
        chosen = []
        rows, columns = np.arange(len(robots)), np.arange(len(urgent))
        for _ in range(_ATTEMPTS):
            pairs = np.transpose(linear_sum_assignment(costs[np.ix_(rows, columns)]))
            done_rows, done_columns, refused = [], [], False
            for row, column in zip(rows[pairs[:, 0]], columns[pairs[:, 1]], strict=True):
                if costs[row, column] >= _IMPOSSIBLE / 2:
                    continue
                robot, task = robots[row], urgent[column]
                effort = effort_of(task, robot.cell, self._travel, robot.profile)
                if self.refuse(task, robot, effort, chargers):
                    costs[row, column] = _IMPOSSIBLE
                    refused = True
                else:
                    chosen.append(Choice(task, robot.id, effort.seconds(robot.profile)))
                    done_rows.append(row)
                    done_columns.append(column)
            if not refused:
                break
            rows, columns = np.setdiff1d(rows, done_rows), np.setdiff1d(columns, done_columns)
        return chosen

    def _price(
        self, tasks: Sequence[Task], group: _Group, now: float, chargers: Sequence[int]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return what tasks cost the robots of one profile, and after how many seconds they can begin.

        Returns:
            Costs and seconds, shape (robots, tasks); ``_IMPOSSIBLE`` and ``inf`` where a robot cannot.
        """
        profile = group.profile
        ways = np.full((len(tasks), len(group.names)), inf)
        needed = np.full(len(tasks), -_IMPOSSIBLE)
        tails: dict[int, Effort] = {}
        for row, task in enumerate(tasks):
            tail = self._tail(task, group)
            if tail is None:
                continue
            tails[row] = tail
            self._write_ways(task, group, ways[row])
            if not charges(task):
                none = Effort(0.0, tail.metres, tail.acting, tail.end)
                needed[row] = self.battery_needed(profile, none, chargers)
        each = share_needed(Effort(1.0, 0.0, 0.0, None), profile)
        if not np.isnan(group.batteries).all():
            ways[needed[:, None] + ways * each > group.batteries] = inf
        nearest = ways.min(axis=1, initial=inf)
        worth = np.zeros(len(tasks))
        for row, tail in tails.items():
            takes = (nearest[row] + tail.metres) / profile.speed + tail.acting
            worth[row] = self.urgency(tasks[row], now, takes if takes < inf else 0.0)
        ways /= profile.speed
        costs = ways - worth[:, None]
        costs[np.isinf(costs)] = _IMPOSSIBLE
        return costs.T, ways.T

    def _tail(self, task: Task, group: _Group) -> Effort | None:
        """Return what a task costs a robot of a profile after its first stop; None if it can never do it."""
        if misfit(task, task.order.robot or group.names[0], group.profile):
            return None
        stop = task.next_stop
        start = stop.cells[0] if stop is not None and stop.cells else int(group.cells[0])
        tail = effort_of(task, start, self._travel, group.profile)
        return tail if tail.first < inf else None

    def _write_ways(self, task: Task, group: _Group, ways: NDArray[np.float64]) -> None:
        """Write the metres to the first stop of a task for each robot that it is for, shape (robots,)."""
        stop = task.next_stop
        cells = stop.cells if stop is not None else ()
        ways[:] = inf if cells else 0.0
        for cell in cells:
            np.minimum(ways, self._travel.field(cell, group.profile.zone_cost)[group.cells], out=ways)
        if task.order.robot:
            ways[[name != task.order.robot for name in group.names]] = inf


class _Group:
    """Robots of one profile, as arrays."""

    def __init__(self, rows: list[int], robots: list[FreeRobot]) -> None:
        self.rows = np.array(rows)
        self.profile = robots[0].profile
        self.names = [robot.id for robot in robots]
        self.cells = np.array([robot.cell for robot in robots])
        self.batteries = np.array(
            [nan if robot.battery is None else robot.battery for robot in robots], np.float64
        )


def _rows_by_profile(robots: Sequence[FreeRobot]) -> list[list[int]]:
    groups: list[tuple[RobotProfile, list[int]]] = []
    places: dict[int, list[int]] = {}
    for row, robot in enumerate(robots):
        rows = places.get(id(robot.profile))
        if rows is None:
            rows = next((known for profile, known in groups if profile == robot.profile), None)
            if rows is None:
                rows = []
                groups.append((robot.profile, rows))
            places[id(robot.profile)] = rows
        rows.append(row)
    return [rows for _, rows in groups]


def misfit(task: Task, robot: str, profile: RobotProfile) -> str:
    """Return why a robot can never do a task, whatever its place and battery; empty if it can."""
    order = task.order
    if order.robot and order.robot != robot:
        return f"only {order.robot} may do it"
    missing = sorted(set(order.capabilities) - set(profile.capabilities))
    if missing:
        return f"it lacks {', '.join(missing)}"
    if order.payload > profile.payload:
        return f"it carries {profile.payload:g} kg, not {order.payload:g} kg"
    return ""
