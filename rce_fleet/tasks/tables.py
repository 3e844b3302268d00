"""The tables of the fleet manager: all its records, and the events that changed them.

Each event has the whole new record of what it changed. :meth:`FleetTables.put` applies events that a journal
kept, so that the tables of a restarted manager are the ones before. The tables have no clock and do no I/O.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from rce_fleet.exceptions import RevisionError, UnknownTaskError
from rce_fleet.tasks.records import (
    BlockedCells,
    FleetEntry,
    FleetEvent,
    GoalEntry,
    Places,
    PlannerRun,
    Record,
    RobotEntry,
    Zone,
    key_of,
)
from rce_fleet.tasks.task import Task, TaskState

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, KeysView

WITH_ROBOT = frozenset({TaskState.RUNNING, TaskState.SUSPENDED, TaskState.CANCELLING})
"""States in which a task occupies its robot; a held task does while its load is on the robot."""

_MOST_DIGITS = 18
"""Digits of a task's number, of 64 bits; Python refuses to read numbers of some thousands."""


class FleetTables:
    """All tasks that have not been forgotten, and what people decided about robots and places.

    Attributes:
        tasks: By number.
        robots: What people decided about robots, by name.
        goals: Where they sent robots, by the robot's name.
        fleet: What they decided about the whole fleet.
        planner: The planner that all this was last compared with.
        places: Chargers, parking places, return cells.
        zones: By name.
        removed_zones: Zones that were removed, and that the planner may still have, by name.
        blocked: Cells that people blocked.
        number: Of the last event.
        last_task: Number of the last task; no number is given twice, also if the task was forgotten.
    """

    def __init__(self) -> None:
        self.tasks: dict[int, Task] = {}
        self.robots: dict[str, RobotEntry] = {}
        self.goals: dict[str, GoalEntry] = {}
        self.fleet = FleetEntry()
        self.planner = PlannerRun()
        self.places = Places()
        self.zones: dict[str, Zone] = {}
        self.removed_zones: dict[str, Zone] = {}
        self.blocked = BlockedCells()
        self.number = 0
        self.last_task = 0
        self._open: dict[int, None] = {}
        self._open_of: Counter[str] = Counter()
        """How many open tasks a requester has."""
        self._by_state: dict[TaskState, dict[int, None]] = {state: {} for state in TaskState}
        self._recurring: dict[int, None] = {}
        """Tasks of which another occurrence follows, ended or not."""
        self._used_cells: Counter[int] = Counter()
        """How many open tasks name a cell."""
        self._by_robot: dict[str, int] = {}
        self._queues: dict[str, dict[int, None]] = {}
        self._by_key: dict[tuple[str, str], dict[int, None]] = {}
        """Numbers of the tasks with a key: of a recurring task all occurrences, the first one first."""
        self._out: list[FleetEvent] = []

    # Records and events

    def put(self, event: FleetEvent) -> None:
        """Apply an event that a journal kept."""
        self.number = max(self.number, event.number)
        self.put_record(event.record)

    def put_record(self, record: Record) -> None:
        """Apply a record that a journal kept."""
        match record:
            case Task():
                self._put_task(record)
            case RobotEntry():
                self.robots[record.id] = record
            case GoalEntry():
                self._put_goal(record)
            case FleetEntry():
                self.fleet = record
            case PlannerRun():
                self.planner = record
            case Places():
                self.places = record
            case Zone():
                self._put_zone(record)
            case BlockedCells():
                self.blocked = record
            case _:
                raise AssertionError(record)

    def emit(self, record: Record, name: str, now: float, *, user: str = "", text: str = "") -> None:
        """Replace a record, and note the event."""
        self.number += 1
        kind, key = key_of(record)
        self._out.append(FleetEvent(self.number, now, kind, key, name, user, text, record))
        self.put_record(record)

    def take_events(self) -> list[FleetEvent]:
        """Return the events since the last call, in order."""
        out, self._out = self._out, []
        return out

    def forget(self, number: int) -> None:
        """Forget a task that has ended, and its key with the last occurrence that has it."""
        task = self.tasks.pop(number)
        self._open.pop(number, None)
        self._recurring.pop(number, None)
        self._leave_indexes(task)
        numbers = self._by_key.get((task.requester, task.key), {})
        numbers.pop(number, None)
        if not numbers:
            self._by_key.pop((task.requester, task.key), None)

    # Questions

    def find(self, task_id: str) -> Task:
        """Return a task.

        Raises:
            UnknownTaskError: There is none of this id.
        """
        number = task_id.removeprefix("T")
        is_number = number.isdecimal() and number.isascii() and len(number) <= _MOST_DIGITS
        task = self.tasks.get(int(number)) if is_number else None
        if task is None or task.id != task_id:
            raise UnknownTaskError(f"there is no task {task_id!r}")
        return task

    def with_key(self, requester: str, key: str) -> Task | None:
        """Return the oldest known task that has a requester's key; None: there is none."""
        number = next(iter(self._by_key.get((requester, key), ())), None)
        return None if number is None else self.tasks[number]

    @property
    def open_count(self) -> int:
        """How many tasks have not ended."""
        return len(self._open)

    def open_count_of(self, requester: str) -> int:
        """Return how many tasks of a requester have not ended."""
        return self._open_of[requester]

    def open_tasks(self) -> Iterator[Task]:
        """Return the tasks that have not ended, oldest first."""
        for number in list(self._open):
            if number in self._open:  # it may end, or be forgotten, while others are looked at
                yield self.tasks[number]

    def open_numbers(self) -> KeysView[int]:
        """Return the numbers of the tasks that have not ended."""
        return self._open.keys()

    def used_cells(self) -> KeysView[int]:
        """Return the cells that the orders of tasks name that have not ended."""
        return self._used_cells.keys()

    def recurring_tasks(self) -> list[Task]:
        """Return the tasks of which another occurrence follows."""
        return [self.tasks[number] for number in self._recurring]

    def numbers(self, states: Collection[str] = ()) -> list[int]:
        """Return the numbers of tasks, ascending.

        Args:
            states: States, or ``open``, ``ended`` and ``recurring``; empty: all tasks.
        """
        if not states:
            return sorted(self.tasks)
        found: set[int] = set()
        for state in states:
            if state == "open":
                found.update(self._open)
            elif state == "ended":
                found.update(self.tasks.keys() - self._open.keys())
            elif state == "recurring":
                found.update(self._recurring)
            else:
                found.update(self._by_state[TaskState(state)])
        return sorted(found)

    def active_tasks(self) -> list[Task]:
        """Return the tasks that occupy robots, oldest first."""
        return [self.tasks[number] for number in sorted(self._by_robot.values())]

    def queue_of(self, robot: str) -> list[Task]:
        """Return the tasks in a robot's queue, in order."""
        return [self.tasks[number] for number in self._queues.get(robot, ())]

    def queues(self) -> dict[str, list[Task]]:
        """Return the tasks in the queues of all robots that have some, by robot."""
        return {robot: self.queue_of(robot) for robot in self._queues}

    def task_of(self, robot: str) -> Task | None:
        """Return the task that occupies a robot."""
        number = self._by_robot.get(robot)
        return None if number is None else self.tasks[number]

    def entry(self, robot: str) -> RobotEntry:
        """Return what people decided about a robot."""
        return self.robots.get(robot) or RobotEntry(robot, revision=0)

    def next_revision(self, zone: Zone | None) -> int:
        """Return the revision of a zone's next change; None: of a new zone.

        A new zone begins above those of a removed one with its name, so that none of their ETags fits.
        """
        return self.number + 1 if zone is None else zone.revision + 1

    def at(self, task_id: str, revision: int | None) -> Task:
        """Return a task at a revision; None: any.

        Raises:
            RevisionError: It is at another one.
            UnknownTaskError: There is no such task.
        """
        task = self.find(task_id)
        if revision is not None and revision != task.revision:
            raise RevisionError(
                f"{task.id} is at revision {task.revision}, not {revision}: read it again, then change it"
            )
        return task

    # Indexes

    def _put_goal(self, entry: GoalEntry) -> None:
        self.goals.pop(entry.id, None)
        if entry.cell is not None or entry.unsent:
            self.goals[entry.id] = entry

    def _put_zone(self, zone: Zone) -> None:
        self.zones.pop(zone.id, None)
        self.removed_zones.pop(zone.id, None)
        if not zone.is_removed:
            self.zones[zone.id] = zone
        elif zone.unsent:
            self.removed_zones[zone.id] = zone

    def _put_task(self, task: Task) -> None:
        before = self.tasks.get(task.number)
        if before is not None:
            self._leave_indexes(before)
        self.tasks[task.number] = task
        self.last_task = max(self.last_task, task.number)
        if task.key:
            self._by_key.setdefault((task.requester, task.key), {})[task.number] = None
        if task.has_ended:
            self._open.pop(task.number, None)
        else:
            self._open[task.number] = None
            self._open_of[task.requester] += 1
            self._used_cells.update(task.order.cells())
        self._by_state[task.state][task.number] = None
        if task.recurs_at is None:
            self._recurring.pop(task.number, None)
        else:
            self._recurring[task.number] = None
        if before is not None:
            self._leave_robot(before)
        if task.robot and (task.state in WITH_ROBOT or task.state is TaskState.HELD):
            self._by_robot[task.robot] = task.number
        elif task.state is TaskState.ASSIGNED:
            self._queues.setdefault(task.robot, {})[task.number] = None

    def _leave_indexes(self, before: Task) -> None:
        """Remove a task's former record from the indexes by state, requester and cell."""
        number = before.number
        self._by_state[before.state].pop(number, None)
        if not before.has_ended:
            self._open_of[before.requester] -= 1
            if not self._open_of[before.requester]:
                del self._open_of[before.requester]
            for cell in before.order.cells():
                self._used_cells[cell] -= 1
                if not self._used_cells[cell]:
                    del self._used_cells[cell]

    def _leave_robot(self, before: Task) -> None:
        """Remove a task's former record from the indexes by robot."""
        if self._by_robot.get(before.robot) == before.number:
            del self._by_robot[before.robot]
        queue = self._queues.get(before.robot)
        if queue is not None and before.state is TaskState.ASSIGNED:
            queue.pop(before.number, None)
            if not queue:
                del self._queues[before.robot]
