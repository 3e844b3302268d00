"""Chooses tasks for idle robots: all at once, by the cheapest sum of ways."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, nan
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rce_fleet.limits import MOST_LATE, within
from rce_fleet.tasks.energy import BatteryLevels, Effort, charges, driven, effort_of, share_needed
from rce_fleet.tasks.matching import cheapest_pairs
from rce_fleet.tasks.tails import tails_of
from rce_fleet.tasks.travel import REFRESHED
from rce_fleet.tasks.urgency import most_urgent_first

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.tasks.records import RobotProfile
    from rce_fleet.tasks.task import Task
    from rce_fleet.tasks.travel import TravelCosts

_SPARE_TASKS = 50
"""So many tasks more than robots, and twice as many as robots, are looked at, the most urgent ones."""
_PRICED = 6_000
"""So many pairs of a task and a profile are looked at in a step, or one profile: each takes some twenty
microseconds. Robots of the other profiles have their turn in the steps after it."""
_FURTHER = 500
"""So many pairs of these are looked at beyond the most urgent tasks, if robots get none of those."""
_LEAST_ENERGY = 1e-3
"""Share of a battery; a robot with less energy is as dear as can be."""
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
        energy: What a task costs a robot whose battery it empties down to ``BatteryLevels.critical``; in
            proportion, what takes a part of the energy above that costs the same part of it.
        fairness: What a robot that has worked all the time is dearer than one that has not worked at all; in
            proportion to :class:`~rce_fleet.tasks.workloads.Workloads`.
    """

    priority: float = 300.0
    age: float = 0.5
    deadline: float = 2.0
    deadline_window: float = 300.0
    keep: float = 10.0
    energy: float = 60.0
    fairness: float = 30.0


class FreeRobot(NamedTuple):
    """A robot that can begin with a task.

    Attributes:
        id: Its name.
        cell: Where it stands.
        profile: What it can do.
        battery: Share of the full battery, 0 .. 1; None: not known, it costs nothing.
        worked: Share of the time in which it had tasks of late, 0 .. 1.
    """

    id: str
    cell: int
    profile: RobotProfile
    battery: float | None
    worked: float = 0.0


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
        self._next_group = 0
        """Counts the groups of robots that had their turn."""
        self._next_task = 0
        """Counts the tasks beyond the most urgent ones that had their turn."""

    def urgency(self, task: Task, now: float, seconds: float = 0.0) -> float:
        """Return what it is worth to begin with a task now, in seconds of way.

        Args:
            task: The task.
            now: Seconds since 1970.
            seconds: About how long it takes.
        """
        rules = self._rules
        since = max(task.created_at, task.order.earliest_start or 0.0)
        worth = task.order.priority * rules.priority + within(now - since, 0.0, MOST_LATE) * rules.age
        if task.order.deadline is not None:
            left = task.order.deadline - now - seconds
            worth += within(rules.deadline_window - left, 0.0, MOST_LATE) * rules.deadline
        return worth

    def refuse(self, task: Task, robot: FreeRobot, effort: Effort, chargers: Sequence[int]) -> str:
        """Return why a robot cannot do a task, whose effort is in metres driven; empty if it can."""
        if reason := misfit(task, robot.id, robot.profile):
            return reason
        if effort.first == inf:
            return "no path leads it to all stops"
        return self.lack_of_energy(task, robot, effort, chargers)

    def lack_of_energy(self, task: Task, robot: FreeRobot, effort: Effort, chargers: Sequence[int]) -> str:
        """Return why a robot's battery is not enough for the rest of a task; empty if it is."""
        if robot.battery is not None and not charges(task):
            needed = self.battery_needed(robot.profile, effort, chargers)
            if needed == inf:
                return "no path leads from its last stop to a charger"
            if robot.battery < needed:
                return f"its battery has {robot.battery:.0%}; task and way to a charger need {needed:.0%}"
        return ""

    def battery_needed(self, profile: RobotProfile, effort: Effort, chargers: Sequence[int]) -> float:
        """Return the share of a full battery that a robot must have to begin with a task.

        Infinite: no path leads from its end to a charger. Chargers in zones that are closed to the robot do
        not count.
        """
        zones = driven(profile.zone_cost)
        end, open_ones = effort.end, [cell for cell in chargers if self._travel.is_open(cell, zones)]
        ways = [self._travel.metres(end, cell, zones) for cell in open_ones if end is not None]
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

        If the robots have very many profiles, some of them are looked at, and the next ones in the next call.
        Robots that can do none of the most urgent tasks get one of some others; of the next ones in the next
        call.

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
        robots = self._in_turn(robots, len(tasks))
        robots = sorted(robots, key=lambda robot: robot.cell)  # Distances are read in the order of cells.
        waiting = most_urgent_first(tasks, now, self._rules)
        groups = _grouped(robots)
        urgent, passed = _suitable(waiting, groups, _most_tasks(len(robots)))
        chosen = self._match(urgent, robots, groups, now, chargers, avoided, begins)
        busy = {choice.robot for choice in chosen}
        left, rest = [robot for robot in robots if robot.id not in busy], waiting[passed:]
        if not left or not rest:
            self._next_task = 0
            return chosen
        groups = _grouped(left)
        further, _ = _suitable(self._further(rest, groups), groups, _FURTHER)
        return chosen + self._match(further, left, groups, now, chargers, avoided, begins)

    def _match(
        self,
        urgent: Sequence[Task],
        robots: Sequence[FreeRobot],
        groups: Sequence[_Group],
        now: float,
        chargers: Sequence[int],
        avoided: Collection[tuple[int, str]],
        begins: Callable[[Task], float],
    ) -> list[Choice]:
        """Return which robots begin with which of some tasks; see :meth:`choose`."""
        for group in groups:
            self._price(urgent, group, now, chargers)
        costs, ways = _joined(groups, len(urgent), len(robots))
        speeds = np.empty(len(robots))
        for group in groups:
            speeds[group.columns] = group.profile.speed
        column_of = {robot.id: column for column, robot in enumerate(robots)}
        row_of = {task.number: row for row, task in enumerate(urgent)}
        for number, name in avoided:
            if number in row_of and name in column_of:
                costs[row_of[number], column_of[name]] = inf
        queued = [(row, task) for row, task in enumerate(urgent) if task.robot]
        for row, task in queued:
            column = column_of.get(task.robot)
            if column is not None and costs[row, column] == inf:
                continue  # its robot is free, and cannot do it
            later = ways[row] / speeds + self._rules.keep >= begins(task)
            if column is not None:
                costs[row, column] -= self._rules.keep
                later[column] = False
            costs[row, later] = inf
        return self._pairs(costs, urgent, robots, groups, chargers)

    def _in_turn(self, robots: Sequence[FreeRobot], tasks: int) -> Sequence[FreeRobot]:
        """Return all robots, or those whose turn it is if they have very many profiles."""
        groups = _columns_by_profile(robots)
        if len(groups) * min(tasks, _most_tasks(len(robots))) <= _PRICED:
            return robots
        chosen: list[FreeRobot] = []
        begin = self._next_group % len(groups)
        for number, columns in enumerate(groups[begin:] + groups[:begin], 1):
            more = [*chosen, *(robots[column] for column in columns)]
            if chosen and number * min(tasks, _most_tasks(len(more))) > _PRICED:
                break
            chosen = more
            self._next_group = begin + number
        return chosen

    def _further(self, tasks: Sequence[Task], groups: Sequence[_Group]) -> list[Task]:
        """Return those of some tasks whose turn it is, so many that they are looked at in a short time."""
        begin = self._next_task % len(tasks)
        zones, budget = groups[0].profile.zone_cost, REFRESHED
        chosen = []
        for task in tasks[begin : begin + max(1, _FURTHER // len(groups))]:
            chosen.append(task)
            cells = [cell for stop in task.order.stops for cell in stop.cells]
            budget -= len(self._travel.missing(cells, zones))
            if budget <= 0:  # each has to be measured
                break
        self._next_task = begin + len(chosen)
        return chosen

    def _pairs(
        self,
        costs: NDArray[np.float64],
        urgent: Sequence[Task],
        robots: Sequence[FreeRobot],
        groups: Sequence[_Group],
        chargers: Sequence[int],
    ) -> list[Choice]:
        """Return the cheapest pairs.

        If a robot can choose among cells, the way to the next stop was not known before: its battery is
        checked again. What is refused then is assigned anew among those that are left.
        """
        chosen = []
        group_of = {column: group for group in groups for column in group.columns.tolist()}
        for _ in range(_ATTEMPTS):
            refused = False
            done: list[tuple[int, int]] = []
            for row, column in np.transpose(cheapest_pairs(costs)).tolist():
                robot, task, group = robots[column], urgent[row], group_of[column]
                stop = task.next_stop
                if stop is not None and len(stop.cells) == 1:
                    first = float(group.ways[row, group.places[robot.id]])
                    effort = group.tails[row]._replace(first=first)
                else:
                    effort = effort_of(task, robot.cell, self._travel, robot.profile)
                    taken = effort_of(task, robot.cell, self._travel, robot.profile, in_metres=True)
                    if self.refuse(task, robot, taken, chargers):
                        costs[row, column] = inf
                        refused = True
                        continue
                chosen.append(Choice(task, robot.id, effort.seconds(robot.profile)))
                done.append((row, column))
            if not refused:
                break
            for row, column in done:
                costs[row] = costs[:, column] = inf
        return chosen

    def _price(self, tasks: Sequence[Task], group: _Group, now: float, chargers: Sequence[int]) -> None:
        """Write what tasks cost the robots of one profile, and how far they are, into the group."""
        profile, travel = group.profile, self._travel
        zones = driven(profile.zone_cost)
        to_chargers: NDArray[np.float32] | None = None
        if open_ones := [cell for cell in chargers if travel.is_open(cell, zones)]:
            to_chargers = np.min([travel.field(cell, zones) for cell in open_ones], axis=0)
        ways = group.ways = np.full((len(tasks), len(group.names)), inf, np.float32)
        metres = ways if zones == profile.zone_cost else ways.copy()
        needed = np.full(len(tasks), -inf)
        taken = np.zeros(len(tasks))
        for row, task in enumerate(tasks):
            if misfit(task, task.order.robot or group.names[0], profile):
                continue
            tails = tails_of(task, group.cells, travel, profile, to_chargers)
            if not tails:
                continue
            group.tails[row] = min(tails, key=lambda tail: tail.metres)
            self._write_ways(task, group, ways[row], profile.zone_cost)
            if metres is not ways:
                self._write_ways(task, group, metres[row], zones)
                tails = tails_of(task, group.cells, travel, profile, to_chargers, in_metres=True) or tails
            if not charges(task):
                rests = [tail._replace(first=0.0) for tail in tails]
                taken[row] = min(share_needed(rest, profile) for rest in rests)
                # In which cell a robot makes the first stop is known later: none is left out for another one.
                needed[row] = min(share_needed(rest, profile, _way(rest.end, to_chargers)) for rest in rests)
        needed += self._levels.critical
        self._forbid_beyond_batteries(group, metres, needed)
        nearest = ways.min(axis=1, initial=inf)
        worth = np.zeros(len(tasks))
        for row, tail in group.tails.items():
            takes = (float(nearest[row]) + tail.metres) / profile.speed + tail.acting
            worth[row] = self.urgency(tasks[row], now, takes if takes < inf else 0.0)
        group.costs = np.divide(ways, profile.speed, dtype=np.float64)
        group.costs -= worth[:, None]
        group.costs += self._rules.fairness * group.worked
        self._add_energy(group, metres, taken)

    def _add_energy(self, group: _Group, metres: NDArray[np.float32], taken: NDArray[np.float64]) -> None:
        """Add what the energy for tasks is worth to robots that have little.

        Args:
            group: Robots, and their costs.
            metres: What they drive to the first stops, shape (tasks, robots).
            taken: What each task takes after its first stop, shares of a battery.
        """
        known = np.flatnonzero(~np.isnan(group.batteries))
        if not self._rules.energy or not len(known):
            return
        each = share_needed(Effort(1.0, 0.0, 0.0, None), group.profile)
        usable = np.maximum(group.batteries[known] - self._levels.critical, _LEAST_ENERGY)
        shares = metres[:, known] * np.float64(each) if each else np.zeros((len(taken), len(known)))
        shares = (shares + taken[:, None]) / usable
        group.costs[:, known] += self._rules.energy * np.minimum(shares, 1.0)

    def _forbid_beyond_batteries(
        self, group: _Group, metres: NDArray[np.float32], needed: NDArray[np.float64]
    ) -> None:
        """Make ways infinite that lead robots so far that their batteries are not enough for the task then.

        Args:
            group: Robots, and their ways.
            metres: What they drive on these, shape (tasks, robots).
            needed: What each task needs after its first stop, shares of a battery.
        """
        if np.isnan(group.batteries).all():
            return
        each = share_needed(Effort(1.0, 0.0, 0.0, None), group.profile)
        with np.errstate(divide="ignore", invalid="ignore"):  # an unknown battery forbids nothing
            rows = np.flatnonzero(metres.max(axis=1) > (np.nanmin(group.batteries) - needed) / each)
            ways = group.ways[rows]
            ways[metres[rows] > (group.batteries - needed[rows, None]) / each] = inf
        group.ways[rows] = ways

    def _write_ways(
        self, task: Task, group: _Group, ways: NDArray[np.float32], zones: Mapping[str, float]
    ) -> None:
        """Write the metres to the first stop of a task for each robot that it is for, shape (robots,)."""
        stop = task.next_stop
        cells = stop.cells if stop is not None else ()
        if len(cells) == 1:
            self._travel.write_metres(group.cells, cells[0], zones, ways)
        else:
            ways[:] = inf if cells else 0.0
            each = np.empty_like(ways)
            for cell in cells:
                self._travel.write_metres(group.cells, cell, zones, each)
                np.minimum(ways, each, out=ways)
        if task.order.robot:
            place = group.places.get(task.order.robot)
            way = inf if place is None else ways[place]
            ways[:] = inf
            if place is not None:
                ways[place] = way


class _Group:
    """Robots of one profile, as arrays, and what tasks cost them.

    Attributes:
        columns: Their places among all robots.
        places: Place of each robot in this group, by name.
        tails: What each task costs after its first stop, by row; tasks that none of them can do are missing.
        ways: Metres to the first stop, shape (tasks, robots); ``inf``: a robot cannot do the task.
        costs: What is to be least, seconds, shape (tasks, robots); ``inf`` likewise.
    """

    ways: NDArray[np.float32]
    costs: NDArray[np.float64]

    def __init__(self, columns: list[int], robots: list[FreeRobot]) -> None:
        self.columns = np.array(columns)
        self.profile = robots[0].profile
        self.names = [robot.id for robot in robots]
        self.places = {name: place for place, name in enumerate(self.names)}
        self.cells = np.array([robot.cell for robot in robots])
        self.batteries = np.array(
            [nan if robot.battery is None else robot.battery for robot in robots], np.float64
        )
        self.worked = np.array([robot.worked for robot in robots], np.float64)
        self.tails: dict[int, Effort] = {}


def _way(cell: int | None, ways: NDArray[np.float32] | None) -> float:
    """Return the metres from a cell, of the ways from all cells; 0 if one of them is not known."""
    return 0.0 if cell is None or ways is None else float(ways[cell])


def _most_tasks(robots: int) -> int:
    """Return how many tasks are looked at for some robots."""
    return max(2 * robots, robots + _SPARE_TASKS)


def _suitable(tasks: Sequence[Task], groups: Sequence[_Group], most: int) -> tuple[list[Task], int]:
    """Return the first ones of some tasks that one of the robots may do, and how many were looked at.

    Args:
        tasks: The tasks.
        groups: The robots.
        most: So many are returned at most.
    """
    names = {name: group for group in groups for name in group.names}
    found = []
    for passed, task in enumerate(tasks, 1):
        only = task.order.robot
        able = ([names[only]] if only in names else []) if only else groups
        if any(not misfit(task, only or group.names[0], group.profile) for group in able):
            found.append(task)
            if len(found) == most:
                return found, passed
    return found, len(tasks)


def _joined(
    groups: Sequence[_Group], tasks: int, robots: int
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return costs and ways of all groups, shape (tasks, robots) both."""
    if len(groups) == 1:
        return groups[0].costs, groups[0].ways
    costs, ways = np.empty((tasks, robots)), np.empty((tasks, robots), np.float32)
    for group in groups:
        costs[:, group.columns], ways[:, group.columns] = group.costs, group.ways
    return costs, ways


def _grouped(robots: Sequence[FreeRobot]) -> list[_Group]:
    by_profile = _columns_by_profile(robots)
    return [_Group(columns, [robots[column] for column in columns]) for columns in by_profile]


def _columns_by_profile(robots: Sequence[FreeRobot]) -> list[list[int]]:
    groups: list[tuple[RobotProfile, list[int]]] = []
    places: dict[int, list[int]] = {}
    for column, robot in enumerate(robots):
        columns = places.get(id(robot.profile))
        if columns is None:
            columns = next((known for profile, known in groups if profile == robot.profile), None)
            if columns is None:
                columns = []
                groups.append((robot.profile, columns))
            places[id(robot.profile)] = columns
        columns.append(column)
    return [columns for _, columns in groups]


def misfit(task: Task, robot: str, profile: RobotProfile) -> str:
    """Return why a robot can never do a task, whatever its place and battery; empty if it can."""
    order = task.order
    if order.robot and order.robot != robot:
        return f"only {order.robot} may do it"
    if order.capabilities and (missing := sorted(set(order.capabilities) - set(profile.capabilities))):
        return f"it lacks {', '.join(missing)}"
    if order.payload > profile.payload:
        return f"it carries {profile.payload:g} kg, not {order.payload:g} kg"
    return ""
