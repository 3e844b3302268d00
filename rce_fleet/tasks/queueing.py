"""Queues of busy robots: each waiting task is inserted where it costs least, the most regretted first.

Regret insertion: J.-Y. Potvin, J.-M. Rousseau, "A parallel route building algorithm for the vehicle routing
and scheduling problem with time windows" (1993).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice
from math import inf
from typing import TYPE_CHECKING

from rce_fleet.tasks.assignment import misfit
from rce_fleet.tasks.energy import Effort, effort_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from rce_fleet.tasks.records import RobotProfile
    from rce_fleet.tasks.task import Task
    from rce_fleet.tasks.travel import TravelCosts

NEAREST = 8
"""So many robots are looked at for each task, those that could be there first."""
MOST_QUEUES, MOST_TASKS = 32, 32
"""So many queues, the shortest ones, and so many tasks, the most urgent ones, are looked at each time."""
MOST_SKIPPED = 32
"""So many tasks that none of these robots can do are passed over each time; the next ones the next time."""


@dataclass(slots=True)
class RobotQueue:
    """The tasks that a robot does after its present one.

    Attributes:
        robot: Its name.
        profile: What it can do.
        cell: Where its present task ends.
        ready: Seconds from now until then.
        tasks: In order.
    """

    robot: str
    profile: RobotProfile
    cell: int
    ready: float
    tasks: list[Task] = field(default_factory=list)


class Queues:
    """Inserts tasks into queues.

    Args:
        travel: Distances.
        length: Most tasks in a queue.
    """

    def __init__(self, travel: TravelCosts, length: int = 3) -> None:
        self._travel = travel
        self._length = length
        self._efforts: dict[tuple[int, int, int], Effort] = {}
        self._next_task = 0
        """Counts the tasks beyond the most urgent ones that had their turn."""

    def begin_step(self) -> None:
        """Forget how long tasks take: the map may be another one."""
        self._efforts.clear()

    def insert(
        self,
        tasks: Sequence[Task],
        queues: Sequence[RobotQueue],
        avoided: Collection[tuple[int, str]] = (),
        lacks_energy: Callable[[Task, RobotQueue], bool] = lambda _task, _queue: False,
    ) -> list[tuple[Task, str]]:
        """Insert tasks into queues, in place; return which task went to which robot.

        Args:
            tasks: Tasks without a robot, the most urgent first.
            queues: Of busy robots.
            avoided: Numbers of tasks with robots that gave them up a short time ago.
            lacks_energy: Returns whether a robot's battery is not enough for a task after its present one.
        """
        self._lacks_energy = lacks_energy
        queues = [queue for queue in queues if len(queue.tasks) < self._length]
        queues = sorted(queues, key=lambda queue: (len(queue.tasks), queue.ready))[:MOST_QUEUES]
        room = sum(self._length - len(queue.tasks) for queue in queues)
        nearest = self._suitable(tasks, queues, avoided, min(room, MOST_TASKS))
        waiting = [task for task in tasks if task.number in nearest]
        places: dict[tuple[int, str], tuple[float, int]] = {}
        options = {task.number: self._options(task, nearest[task.number], places) for task in waiting}
        inserted = []
        while waiting:
            task = max(waiting, key=lambda each: _regret(options[each.number]))
            waiting.remove(task)
            if not options[task.number]:
                continue
            _, place, queue = min(options[task.number], key=lambda option: option[0])
            queue.tasks.insert(place, task)
            inserted.append((task, queue.robot))
            for other in waiting:
                places.pop((other.number, queue.robot), None)
                if any(option[2] is queue for option in options[other.number]):
                    options[other.number] = self._options(other, nearest[other.number], places)
        return inserted

    def finish(self, queue: RobotQueue) -> float:
        """Return the seconds until a robot has done its queue; ``inf`` if it cannot."""
        seconds, cell = queue.ready, queue.cell
        for task in queue.tasks:
            took, cell = self._leg(task, cell, queue.profile)
            seconds += took
        return seconds

    def begin(self, queue: RobotQueue, task: Task) -> float:
        """Return the seconds until a robot is at the first stop of a task in its queue.

        Returns:
            ``inf`` if it cannot get there.
        """
        place = next(place for place, each in enumerate(queue.tasks) if each.number == task.number)
        seconds, cell = queue.ready, queue.cell
        for each in queue.tasks[:place]:
            took, cell = self._leg(each, cell, queue.profile)
            seconds += took
        return seconds + self._effort(task, cell, queue.profile).first / queue.profile.speed

    def _suitable(
        self,
        tasks: Sequence[Task],
        queues: Sequence[RobotQueue],
        avoided: Collection[tuple[int, str]],
        most: int,
    ) -> dict[int, list[RobotQueue]]:
        """Return, by the numbers of tasks that are looked at now, the queues of robots that can do them.

        Args:
            tasks: The most urgent first.
            queues: The queues.
            avoided: See :meth:`insert`.
            most: So many tasks are returned at most.
        """
        found: dict[int, list[RobotQueue]] = {}
        begin = self._next_task if MOST_TASKS < self._next_task < len(tasks) else MOST_TASKS
        self._next_task = begin + MOST_SKIPPED
        for task in (*tasks[:MOST_TASKS], *tasks[begin : self._next_task]):
            if len(found) >= most:
                self._next_task = 0
                break
            if nearest := self._nearest_first(task, queues, avoided):
                found[task.number] = nearest
        return found

    def _nearest_first(
        self, task: Task, queues: Sequence[RobotQueue], avoided: Collection[tuple[int, str]]
    ) -> list[RobotQueue]:
        """Return the queues of robots that can do a task, by when they would have done it as their first."""
        ends = []
        for queue in queues:
            if misfit(task, queue.robot, queue.profile) or (task.number, queue.robot) in avoided:
                continue
            took, _ = self._leg(task, queue.cell, queue.profile)
            if took < inf and not self._lacks_energy(task, queue):
                ends.append((queue.ready + took, queue.robot, queue))
        ends.sort(key=lambda end: end[:2])
        return [queue for _, _, queue in ends]

    def _options(
        self, task: Task, nearest: Sequence[RobotQueue], places: dict[tuple[int, str], tuple[float, int]]
    ) -> list[tuple[float, int, RobotQueue]]:
        """Return the best place in each of the nearest queues: when all is done there, place and queue.

        Args:
            task: The task.
            nearest: Queues, the nearest first.
            places: Best places that are known, by number of a task and robot; others are added.
        """
        options = []
        with_room = (queue for queue in nearest if len(queue.tasks) < self._length)
        for queue in islice(with_room, NEAREST):
            key = task.number, queue.robot
            best = places.get(key)
            if best is None:
                best = places[key] = self._best_place(task, queue)
            if best[0] < inf:
                options.append((*best, queue))
        return options

    def _best_place(self, task: Task, queue: RobotQueue) -> tuple[float, int]:
        """Return when a queue with a task at its best place would be done, and that place."""
        best = (inf, 0)
        for place in range(len(queue.tasks) + 1):
            trial = RobotQueue(queue.robot, queue.profile, queue.cell, queue.ready, [*queue.tasks])
            trial.tasks.insert(place, task)
            best = min(best, (self.finish(trial), place))
        return best

    def _leg(self, task: Task, cell: int, profile: RobotProfile) -> tuple[float, int]:
        """Return how long a task takes a robot in a cell, and where it is then."""
        effort = self._effort(task, cell, profile)
        return effort.seconds(profile), cell if effort.end is None else effort.end

    def _effort(self, task: Task, cell: int, profile: RobotProfile) -> Effort:
        key = (task.number, cell, id(profile))
        effort = self._efforts.get(key)
        if effort is None:
            effort = self._efforts[key] = effort_of(task, cell, self._travel, profile)
        return effort


def _regret(options: list[tuple[float, int, RobotQueue]]) -> float:
    """Return how much worse the second best robot is; a task with one robot goes first."""
    costs = sorted(option[0] for option in options)
    return inf if len(costs) == 1 else -inf if not costs else costs[1] - costs[0]
