"""One step of the fleet manager: robots' progress, conditions of tasks, charging, assignment, parking."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.tasks.assignment import Assigner, AssignmentRules, FreeRobot, misfit
from rce_fleet.tasks.batches import Batch, Batches
from rce_fleet.tasks.charging import ChargerQueue
from rce_fleet.tasks.conditions import Conditions
from rce_fleet.tasks.energy import BatteryLevels, driven, effort_of
from rce_fleet.tasks.explaining import why_none, why_none_drives
from rce_fleet.tasks.idle_ways import IdleWays
from rce_fleet.tasks.matching_loops import match_rows
from rce_fleet.tasks.parking import Parking, ParkingCells, full_zones
from rce_fleet.tasks.progress import ProgressRules, TaskProgress
from rce_fleet.tasks.records import AUTOMATIC, RobotProfile
from rce_fleet.tasks.robot_queues import RobotQueues
from rce_fleet.tasks.tails import tails_of
from rce_fleet.tasks.task import Task, TaskCause, TaskState
from rce_fleet.tasks.travel import MOST_GRAPHS, TravelCosts
from rce_fleet.tasks.travel_loops import measure_ways
from rce_fleet.tasks.urgency import most_urgent_first
from rce_fleet.tasks.workloads import Workloads
from rce_fleet.tasks.zone_costs import zone_profiles

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rce_fleet.tasks.book import TaskBook
    from rce_fleet.tasks.charging import ChargerUser
    from rce_fleet.tasks.facts import FleetFacts, RobotFacts

QUEUES_EVERY = 2.0
"""Seconds between two looks at the queues of busy robots and at tasks that no robot can do."""
MOST_EXPLAINED = 50
"""Waiting tasks that are looked at each time, to say why no robot can do them; the others come later."""


@dataclass(frozen=True, slots=True)
class TaskRules:
    """The rules of a fleet manager.

    Attributes:
        progress: When a robot loses its task.
        assignment: What counts when a task is chosen.
        battery: Thresholds of batteries.
        profile: What robots can do that have no profile of their own.
        queue_length: Most tasks in the queue of a busy robot.
        park_after: An idle robot goes out of the way after this time, seconds.
    """

    progress: ProgressRules = field(default_factory=ProgressRules)
    assignment: AssignmentRules = field(default_factory=AssignmentRules)
    battery: BatteryLevels = field(default_factory=BatteryLevels)
    profile: RobotProfile = field(default_factory=RobotProfile)
    queue_length: int = 3
    park_after: float = 5.0


def load_libraries() -> None:
    """Load what measures ways and chooses tasks, which takes a second where the loops are not compiled.

    To be called in a thread before the first tasks: the event loop would stand still for that time.
    """
    match_rows(np.zeros((1, 1)))
    none = np.zeros(0, np.int32)
    measure_ways(np.zeros(2, np.int32), none, np.zeros(0), np.zeros(1, np.int32))


class Dispatcher:
    """Decides what the robots do.

    Args:
        book: The tasks.
        rules: The rules.

    Attributes:
        chargers: Who charges, and who waits.
    """

    def __init__(self, book: TaskBook, rules: TaskRules | None = None) -> None:
        self.rules = rules or TaskRules()
        self._book = book
        self._travel = TravelCosts()
        self._progress = TaskProgress(book, self.rules.progress, charged=self.rules.battery.full)
        self._conditions = Conditions(book)
        self._assigner = Assigner(self._travel, self.rules.assignment, self.rules.battery)
        length, full = self.rules.queue_length, self.rules.battery.full
        self._queues = RobotQueues(book, self._travel, self.profile, length, full)
        self._ways = IdleWays(self.rules.progress, self._nearest)
        self.chargers = ChargerQueue(self.rules.battery, self._ways)
        self._parking = Parking(self._ways, self.rules.park_after)
        self._workloads = Workloads()
        self._has_counted = False
        """Whether the tasks of a journal are counted as work."""
        self._profiles: dict[str, RobotProfile] = {}
        """Of robots for which zones count."""
        self._queues_due = -inf
        self._batches = Batches(self._travel, self.rules.assignment, self.rules.queue_length)
        self._found: tuple[Batch, list[list[int]]] | None = None
        """Better queues that the next look at the queues takes over."""
        self._explained = 0
        self._facts: FleetFacts | None = None
        self._fastest = self.rules.profile
        """The profile of the fastest robot."""
        self._measured: set[int] = set()
        """Numbers of open tasks; the distances to their stops were measured."""
        self._measured_epoch = 0

    def profile(self, robot: str) -> RobotProfile:
        """Return what a robot can do."""
        return self._profiles.get(robot) or self._book.entry(robot).profile or self.rules.profile

    def measure(self, facts: FleetFacts) -> bool:
        """Measure some of the distances that the next step needs, so that it does not stop for all of them.

        :meth:`update` measures what is missing then.

        Args:
            facts: What is known of the robots.

        Returns:
            Whether more are left; to be called again when other work has been done meanwhile.
        """
        travel, book = self._travel, self._book
        if facts.grid is None or not facts.is_live:
            return False
        travel.set_map(facts.grid, facts.shut, book.zones, facts.map_revision, facts.lanes)
        if travel.epoch != self._measured_epoch:
            self._measured_epoch, self._measured = travel.epoch, set()
        self._measured &= book.open_numbers()
        tasks = [book.tasks[number] for number in book.open_numbers() - self._measured]
        if not tasks:
            return False
        self._profiles = zone_profiles(book, facts, self.rules.profile)
        costs = [self.profile(name).zone_cost for name in facts.robots]
        each_once = {id(cost): cost for cost in costs}.values()
        zone_costs = {str(cost): cost for each in each_once for cost in (each, driven(each))}
        stops = book.used_cells() if len(zone_costs) > 1 else ()
        if len(zone_costs) > MOST_GRAPHS or len(zone_costs) * len(stops) > travel.capacity:
            zone_costs = {"": {}}  # The distances of each robot's own zones follow in the steps.
        missing: dict[str, set[int]] = {name: set() for name in zone_costs}
        tasks.sort(key=lambda task: (-task.order.priority, task.number))
        for task in tasks:
            # More than are kept are left to the steps that need them.
            if sum(map(len, missing.values())) >= travel.at_once or len(self._measured) >= travel.capacity:
                break
            last = min(task.order.length, task.position + len(task.order.stops))
            cells = [cell for stop in range(task.position, last) for cell in task.order.stop(stop).cells]
            for name, cost in zone_costs.items():
                missing[name].update(travel.missing(cells, cost))
            self._measured.add(task.number)
        else:
            tasks = []
        for name, cost in zone_costs.items():
            travel.measure(sorted(missing[name]), cost)
        return bool(tasks) and len(self._measured) < travel.capacity

    def update(self, now: float, facts: FleetFacts) -> None:
        """Take one step.

        Args:
            now: Seconds since 1970.
            facts: What is known of the robots.
        """
        for _ in self.parts(now, facts):
            pass

    def parts(self, now: float, facts: FleetFacts) -> Iterator[None]:
        """Take one step, a part each time that the iterator is asked for the next one.

        Between two parts requests can be answered, and facts change. Tasks that requests change then have
        their turn in the next step.

        Args:
            now: Seconds since 1970.
            facts: What is known of the robots.
        """
        self._travel.begin_step()
        self._follow(now, facts)
        yield
        self._conditions.update(now)
        self._count_work(now, facts)
        yield
        if not self._begin_part(facts):
            return
        self._assign(now, facts)
        if self._queues_due - 2 * QUEUES_EVERY <= now < self._queues_due:
            return
        yield
        if not self._begin_part(facts):
            return
        self._queues_due = now + QUEUES_EVERY
        self._fill_queues(now, facts)
        self._conditions.refresh()
        yield
        if self._begin_part(facts):
            self._explain(facts, now)

    def batch(self, now: float, facts: FleetFacts) -> Batch | None:
        """Return some robots whose queues may be better; others each time, if there are many.

        Args:
            now: Seconds since 1970.
            facts: What is known of the robots.
        """
        queued = self._book.queues().keys()
        if not queued or facts.grid is None or not facts.is_live:
            return None
        self._queues.begin_step()
        self._take_map(facts)
        working = [robot for robot in facts.robots.values() if self._queues.takes_part(robot)]
        chosen = self._batches.choose(working, queued, facts.grid)
        queues = self._queues.improvable(now, chosen)
        tasks = {queue.robot: self._book.task_of(queue.robot) for queue in queues}
        present = {robot: task.number for robot, task in tasks.items() if task is not None}
        return self._batches.make(queues, present, now, self._progress.avoid.keys(), self._weak(chosen))

    def _weak(self, robots: Iterable[RobotFacts]) -> set[str]:
        """Return the robots whose batteries are too low for tasks of others."""
        least = self.rules.battery.sufficient
        return {robot.id for robot in robots if robot.battery is not None and robot.battery < least}

    def adopt(self, batch: Batch, routes: list[list[int]]) -> None:
        """Take better queues over in the next step, unless something has changed by then.

        Args:
            batch: What they were found for.
            routes: The tasks of each robot, by their numbers in the batch's problem.
        """
        self._found, self._queues_due = (batch, routes), -inf

    def goals(self) -> dict[str, int | None]:
        """Return where robots shall go; None: the robot shall stand still. Others have no goal."""
        goals: dict[str, int | None] = dict(self._parking.cells)
        goals.update(self.chargers.charging)
        for task in self._book.active_tasks():
            stands = task.state in (TaskState.HELD, TaskState.SUSPENDED)
            goals[task.robot] = None if stands and task.action is None else task.target
        for robot, entry in self._book.robots.items():
            if entry.is_out:
                goals[robot] = None
        return goals

    def avoid(self, task: Task, robot: str, now: float) -> None:
        """Do not give a task to a robot again for a while."""
        self._progress.avoid[task.number, robot] = now + self.rules.progress.avoid_for

    def leave_floor(self) -> None:
        """Forget cells where robots charge or wait: the planner has another grid."""
        self.chargers.charging.clear()
        self._parking.cells.clear()
        self._ways.leave_floor()

    def activity(self, robot: str) -> str:
        """Return what a robot does for the manager, in one word."""
        entry, task = self._book.entry(robot), self._book.task_of(robot)
        facts = self._facts.robots.get(robot) if self._facts is not None else None
        modes = {entry.mode, facts.mode if facts is not None else AUTOMATIC}
        doings = (
            (entry.is_out, "out"),
            ("manual" in modes, "by hand"),
            (bool(modes - {AUTOMATIC}), "paused"),
            (task is not None, "task"),
            (robot in self.chargers.charging, "charging"),
            (robot in self.chargers.waiting, "waiting for a charger"),
            (robot in self._parking.cells, "parking"),
        )
        return next((word for does, word in doings if does), "idle")

    def expected_end(self, task: Task, now: float) -> float | None:
        """Return when a robot will have done a task, seconds since 1970; None: not known."""
        facts = self._facts.robots.get(task.robot) if self._facts is not None else None
        if task.state not in (TaskState.RUNNING, TaskState.ASSIGNED) or facts is None or facts.cell is None:
            return None
        if task.state is TaskState.RUNNING:
            left = self._queues.left(task, facts, now)[0]
        else:
            left = self._queues.until_done(task, now, facts)
        return None if left == inf else now + left

    def earliest_end(self, task: Task, now: float) -> float | None:
        """Return about when a task that waits would be done if a robot began it at its first stop now.

        Args:
            task: The task. One that must not begin yet is taken to begin at its earliest start.
            now: Seconds since 1970.

        Returns:
            Seconds since 1970; None: it has a robot, or the ways between its stops are not known.
        """
        if task.state not in (TaskState.QUEUED, TaskState.HELD) or task.robot or not self._travel.has_map:
            return None
        profile = self.profile(task.order.robot) if task.order.robot else self._fastest
        last = min(task.order.length, task.position + len(task.order.stops))
        cells = [cell for stop in range(task.position, last) for cell in task.order.stop(stop).cells]
        if self._travel.missing(cells, profile.zone_cost):
            return None  # measured by a step: a request must not take so long
        tails = tails_of(task, np.zeros(1, np.int64), self._travel, profile, None)
        takes = min((tail.seconds(profile) for tail in tails), default=inf)
        return None if takes == inf else max(now, task.order.earliest_start or now) + takes

    # Parts of a step

    def _count_work(self, now: float, facts: FleetFacts) -> None:
        if not self._has_counted:
            self._has_counted = True
            known = {*self._book.robots, *facts.robots}
            self._workloads.begin(known, self._book.tasks.values(), now)
        busy = {task.robot for task in self._book.active_tasks()}
        self._workloads.update(now, facts.robots, busy)

    def _begin_part(self, facts: FleetFacts) -> bool:
        """Take over what has changed since the part before; return whether robots can be given tasks."""
        self._conditions.leave_changed()
        self._queues.begin_step()
        self._take_map(facts)
        return facts.grid is not None and facts.is_live

    def _take_map(self, facts: FleetFacts) -> None:
        if facts.grid is not None:
            zones = self._book.zones
            self._travel.set_map(facts.grid, facts.shut, zones, facts.map_revision, facts.lanes)

    def _follow(self, now: float, facts: FleetFacts) -> None:
        """Take over what the robots with tasks did."""
        self._facts = facts
        self._queues.begin_step()
        self._profiles = zone_profiles(self._book, facts, self.rules.profile)
        profiles = map(self.profile, facts.robots)
        self._fastest = max(profiles, key=lambda profile: profile.speed, default=self.rules.profile)
        self._take_map(facts)
        users = self._charger_users(facts)
        self._progress.update(now, facts, self._nearest, self._short_of_energy, users)
        self._release_misfits(now)

    def _assign(self, now: float, facts: FleetFacts) -> None:
        """Give tasks to idle robots; the others charge, or get out of the way."""
        book = self._book
        idle = {robot.id: robot for robot in facts.robots.values() if self._is_idle(robot)}
        taken = self._progress.targets()
        self._ways.begin_step(now, self._progress.standing)
        self.chargers.adopt(idle, book.places.chargers, taken)
        free = [self._free(robot) for robot in idle.values() if self.chargers.can_work(robot)]
        working = {robot.id for robot in free}

        def begins(task: Task) -> float:
            return self._queues.begins(task, now, facts.robots.get(task.robot), working)

        ready, avoided = self._conditions.ready, self._progress.avoid.keys()
        by_clock = book.clock_time(now)  # by which deadlines are urgent
        for choice in self._assigner.choose(ready, free, by_clock, self._open_chargers(), avoided, begins):
            self._start(choice.task, choice.robot, now)
            idle.pop(choice.robot, None)
        self._conditions.refresh()
        self.chargers.update(idle, book.places.chargers, taken)
        used = {*book.places.chargers}.union(book.used_cells())
        used |= full_zones(book.zones.values(), facts, used)
        own_zones = [zone for zone in book.zones.values() if zone.kind == "blocked" and zone.robots]
        barring = {robot.barred_by for robot in facts.robots.values() if robot.barred_by is not None}
        cells = ParkingCells(frozenset(book.places.parking), used, taken.keys(), own_zones, barring)
        self._parking.update(now, idle, self.chargers.charging, facts, cells)

    def _nearest(self, robot: RobotFacts, cells: Iterable[int]) -> int | None:
        if robot.cell is None:
            return None
        return self._travel.nearest(robot.cell, cells, self.profile(robot.id).zone_cost)

    def _short_of_energy(self, task: Task, robot: RobotFacts) -> str:
        if robot.cell is None or robot.battery is None or not self._travel.has_map:
            return ""
        free = self._free(robot)
        effort = effort_of(task, free.cell, self._travel, free.profile, in_metres=True)
        lack = self._assigner.lack_of_energy(task, free, effort, self._open_chargers())
        return "" if effort.first == inf else lack

    def _open_chargers(self) -> tuple[int, ...]:
        """Return the chargers that are not blocked.

        While all are, batteries need only their critical share beside what a task takes: a person who stands
        on the only charger does not stop the fleet.
        """
        shut = frozenset() if self._facts is None else self._facts.shut
        return tuple(cell for cell in self._book.places.chargers if cell not in shut)

    def _charger_users(self, facts: FleetFacts) -> dict[int, ChargerUser]:
        chargers, charging = {*self._book.places.chargers}, self.chargers.charging
        near = (each for each in facts.robots.values() if each.cell in chargers or each.id in charging)
        return self.chargers.users(filter(self._is_idle, near), chargers)

    def _is_idle(self, robot: RobotFacts) -> bool:
        entry = self._book.entry(robot.id)
        busy = entry.mode != AUTOMATIC or robot.by_hand
        return robot.is_driven and not busy and self._book.task_of(robot.id) is None

    def _free(self, robot: RobotFacts) -> FreeRobot:
        assert robot.cell is not None
        worked = self._workloads.share(robot.id)
        return FreeRobot(robot.id, robot.cell, self.profile(robot.id), robot.battery, worked)

    def _start(self, task: Task, robot: str, now: float) -> None:
        self._parking.cells.pop(robot, None)
        self.chargers.charging.pop(robot, None)
        if task.state is TaskState.ASSIGNED and task.robot != robot:
            text = f"{robot} takes it from the queue of {task.robot}"
            task = self._book.advance(task, TaskCause.RELEASE, now, text, robot="")
        started = now if task.started_at is None else task.started_at
        self._book.advance(
            task, TaskCause.START, now, f"{robot} begins", robot=robot, target=None, started_at=started
        )

    def _release_misfits(self, now: float) -> None:
        """Take tasks from robots that do not fit any more, because task or profile was changed."""
        for task in self._book.active_tasks():
            if task.state is TaskState.RUNNING and not task.is_bound:
                reason = misfit(task, task.robot, self.profile(task.robot))
                if reason:
                    text = f"{task.robot} cannot do it any more: {reason}"
                    self._book.advance(task, TaskCause.RELEASE, now, text, robot="", target=None)

    def _fill_queues(self, now: float, facts: FleetFacts) -> None:
        """Give tasks to the queues of busy robots, and take them from robots that cannot do them."""
        for name, tasks in self._book.queues().items():
            for task in tasks:
                if reason := self._why_not(task, name, facts.robots.get(name)):
                    self._book.advance(task, TaskCause.RELEASE, now, reason, robot="")
        if self._found is not None:
            batch, routes = self._found
            weak = self._weak(facts.robots.values())
            self._queues.adopt(batch, routes, now, facts.robots, self._progress.avoid.keys(), weak)
            self._found = None
        self._conditions.refresh()  # Another robot may take what was released.
        if busy := self._queues.busy(now, facts.robots.values()):
            waiting = [task for task in self._conditions.ready if task.state is TaskState.QUEUED]
            waiting = most_urgent_first(waiting, self._book.clock_time(now), self.rules.assignment)
            lack = partial(self._assigner.lack_of_energy, chargers=self._open_chargers())
            self._queues.fill(waiting, busy, now, self._progress.avoid.keys(), facts.robots, lack)

    def _why_not(self, task: Task, name: str, robot: RobotFacts | None) -> str:
        """Return why a robot cannot keep a task in its queue; empty if it can."""
        if robot is None or not robot.is_there or self._book.entry(name).is_out:
            return f"{name} is not there"
        free = self._free(robot)
        reason = misfit(task, name, free.profile)
        if not reason and self._book.task_of(name) is None:
            effort = effort_of(task, free.cell, self._travel, free.profile, in_metres=True)
            reason = self._assigner.refuse(task, free, effort, self._open_chargers())
        return f"{name} cannot do it: {reason}" if reason else ""

    def _explain(self, facts: FleetFacts, now: float) -> None:
        """Say of tasks that wait why no robot can do them."""
        robots = [robot for robot in facts.robots.values() if not self._book.entry(robot.id).is_out]
        placed = [self._free(robot) for robot in robots if robot.cell is not None]
        placed.sort(key=lambda robot: 1.0 if robot.battery is None else robot.battery, reverse=True)
        known: dict[object, str] = {}
        waiting = [task for task in self._conditions.ready if task.state is TaskState.QUEUED]
        begin = self._explained % len(waiting) if waiting else 0
        self._explained = begin + MOST_EXPLAINED
        for task in (waiting[begin:] + waiting[:begin])[:MOST_EXPLAINED]:
            like = (
                task.position,
                replace(task.order, name="", priority=0, deadline=None, earliest_start=None),
            )
            if like not in known:
                known[like] = self._why_waiting(task, robots, placed, facts)
            self._conditions.note(task, known[like], now)

    def _why_waiting(
        self, task: Task, robots: Sequence[RobotFacts], placed: Sequence[FreeRobot], facts: FleetFacts
    ) -> str:
        """Return why no robot in service can do a task; empty if one can, and is only busy.

        Args:
            task: The task.
            robots: Robots in service.
            placed: Those of them whose cell is known.
            facts: What is known of the fleet.
        """
        if not robots:
            return "no robot is in service"
        if not placed:
            return why_none_drives(robots)
        if only := task.order.robot:
            robots = [robot for robot in robots if robot.id == only]
            placed = [robot for robot in placed if robot.id == only]
        reason = why_none(task, placed, self._travel, self._assigner, self._open_chargers())
        if reason or facts.mode != AUTOMATIC:  # the fleet stands: people know why
            return reason
        return why_none_drives(
            robot for robot in robots if not misfit(task, robot.id, self.profile(robot.id))
        )
