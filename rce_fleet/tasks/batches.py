"""Batches of queued tasks that may be better in the queues of other busy robots.

:mod:`~rce_fleet.tasks.queueing` inserts each task once, where it is best at that time. Later tasks and delays
make other choices better. A :class:`Batch` describes some robots with their queues as a vehicle routing
problem with open routes: each robot begins where and when its present task ends. It is solved elsewhere
(:mod:`rce_fleet.tasks.routing`), which takes a part of a second. The tasks that the answer gives to other
robots change their queues, if those are still what they were. The order within a queue is not adopted: each
robot that becomes idle chooses the next task by its costs at that time.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rce_fleet.limits import within
from rce_fleet.tasks.assignment import misfit
from rce_fleet.tasks.energy import effort_of
from rce_fleet.tasks.order import Action
from rce_fleet.tasks.routing_problem import RoutingProblem

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from rce_fleet.planning.grid import GridMap
    from rce_fleet.tasks.assignment import AssignmentRules
    from rce_fleet.tasks.facts import RobotFacts
    from rce_fleet.tasks.queueing import RobotQueue
    from rce_fleet.tasks.records import RobotProfile
    from rce_fleet.tasks.task import Task
    from rce_fleet.tasks.travel import TravelCosts

MOST_ROBOTS = 24
"""So many robots near to each other are in a batch; in a larger fleet others have their turn in the next."""
MOST_PROFILES = 4
"""Profiles of the robots in a batch: the times of all tasks are computed for each."""
LATEST_S = 60.0
"""Better queues that come so long after their batch was made are not taken over."""
MOST_WEIGHT = 10
"""What a task of high priority counts, of those that count 1 at least."""


class Move(NamedTuple):
    """A task that gets another robot.

    Attributes:
        task: Its number.
        source: The robot in whose queue it is.
        target: The robot in whose queue it shall be.
    """

    task: int
    source: str
    target: str


@dataclass(frozen=True)
class Batch:
    """Robots and the tasks in their queues at some time.

    Attributes:
        made_at: When it was made, seconds since 1970.
        map_version: That of the distances.
        robots: Their names.
        present: Number of each robot's present task.
        queues: The tasks in each robot's queue.
        problem: The same as a problem to solve; its tasks are those of the queues, one queue after the other.
    """

    made_at: float
    map_version: int
    robots: tuple[str, ...]
    present: tuple[int, ...]
    queues: tuple[tuple[Task, ...], ...]
    problem: RoutingProblem

    def moves(self, routes: Sequence[Sequence[int]]) -> list[Move]:
        """Return the tasks that get other robots.

        Args:
            routes: The tasks of each robot, by their numbers in the problem.
        """
        numbers = [task.number for queue in self.queues for task in queue]
        source = {task.number: robot for robot, queue in enumerate(self.queues) for task in queue}
        return [
            Move(number, self.robots[source[number]], self.robots[target])
            for target, route in enumerate(routes)
            for number in (numbers[task] for task in route)
            if source[number] != target
        ]

    def is_still(self, robot: str, present: int, queue: Sequence[Task]) -> bool:
        """Return whether a robot has the tasks that it had when the batch was made, and none was changed.

        Args:
            robot: Its name.
            present: Number of its present task.
            queue: The tasks in its queue, in any order.
        """
        place = self.robots.index(robot)
        before, now = ({task.number: task.order for task in tasks} for tasks in (self.queues[place], queue))
        return self.present[place] == present and before == now


def is_plannable(task: Task) -> bool:
    """Return whether it can be told when and where a robot will have done a task.

    That is not known of stops in one of several cells, of stops that charge and of those that people confirm.
    """
    return all(
        len(stop.cells) == 1 and stop.action is not Action.CHARGE and not stop.confirm
        for stop in task.order.stops
    )


class Batches:
    """Makes batches.

    Args:
        travel: Distances.
        rules: What counts.
        length: Most tasks in a queue.
    """

    def __init__(self, travel: TravelCosts, rules: AssignmentRules, length: int) -> None:
        self._travel = travel
        self._rules = rules
        self._length = length
        self._turn = 0
        """Counts batches."""

    def choose(
        self, robots: Sequence[RobotFacts], queued: Collection[str], grid: GridMap
    ) -> list[RobotFacts]:
        """Return robots for the next batch: one with queued tasks, another one each time, and those near it.

        Args:
            robots: Busy robots that take part; their cells are known.
            queued: Names of robots with queued tasks.
            grid: The grid.
        """
        having = [place for place, robot in enumerate(robots) if robot.id in queued]
        if not having or len(robots) < 2:  # noqa: PLR2004 - a task moves from one robot to another
            return []
        middle = having[self._turn % len(having)]
        self._turn += 1
        cells = np.array([robot.cell for robot in robots], np.int64)
        rows, columns = np.divmod(cells, grid.columns)
        away = abs(rows - rows[middle]) + abs(columns - columns[middle])
        return [robots[place] for place in np.argsort(away, kind="stable")[:MOST_ROBOTS].tolist()]

    def make(
        self,
        queues: Sequence[RobotQueue],
        present: Mapping[str, int],
        now: float,
        avoided: Collection[tuple[int, str]] = (),
        weak: Collection[str] = (),
    ) -> Batch | None:
        """Return a batch; None if it has no task that could get another robot.

        Args:
            queues: Of busy robots, with tasks of which :func:`is_plannable` is true.
            present: Number of the present task of each robot, by name.
            now: Seconds since 1970.
            avoided: Numbers of tasks with robots that gave them up a short time ago.
            weak: Robots that get no tasks of others, as they must charge soon.
        """
        profiles: list[RobotProfile] = []
        for queue in queues:
            if queue.profile not in profiles and len(profiles) < MOST_PROFILES:
                profiles.append(queue.profile)
        queues = [queue for queue in queues if queue.profile in profiles]
        tasks = [task for queue in queues for task in queue.tasks]
        able = [
            [
                place
                for place, queue in enumerate(queues)
                if queue.robot not in weak
                and (task.number, queue.robot) not in avoided
                and not misfit(task, queue.robot, queue.profile)
            ]
            for task in tasks
        ]
        owners = [place for place, queue in enumerate(queues) for _ in queue.tasks]
        if not any(set(robots) - {owner} for robots, owner in zip(able, owners, strict=True)):
            return None
        starts = [queue.cell for queue in queues]
        places = iter(range(len(tasks)))
        problem = RoutingProblem(
            ready=[queue.ready for queue in queues],
            profiles=[profiles.index(queue.profile) for queue in queues],
            seconds=[self._seconds(tasks, starts, profile).tolist() for profile in profiles],
            queues=[[next(places) for _ in queue.tasks] for queue in queues],
            able=able,
            weights=[1 + int(within(task.order.priority, 0, MOST_WEIGHT - 1)) for task in tasks],
            deadlines=[inf if (at := task.order.deadline) is None else at - now for task in tasks],
            late=self._rules.deadline,
            length=self._length,
            keep=self._rules.keep,
        )
        return Batch(
            now,
            self._travel.version,
            tuple(queue.robot for queue in queues),
            tuple(present[queue.robot] for queue in queues),
            tuple(tuple(queue.tasks) for queue in queues),
            problem,
        )

    def _seconds(
        self, tasks: Sequence[Task], starts: Sequence[int], profile: RobotProfile
    ) -> NDArray[np.float64]:
        """Return how long tasks take robots of a profile from each place, shape (robots + tasks, tasks)."""
        firsts = [stop.cells[0] if (stop := task.next_stop) is not None else starts[0] for task in tasks]
        tails = [
            effort_of(task, first, self._travel, profile) for task, first in zip(tasks, firsts, strict=True)
        ]
        # No robot of this profile gets to the end of a task that it cannot do: any cell will do there.
        cells = np.array([*starts, *(starts[0] if tail.end is None else tail.end for tail in tails)])
        seconds = np.full((len(cells), len(tasks)), inf)
        ways = np.empty(len(cells), np.float32)
        for column, (first, tail) in enumerate(zip(firsts, tails, strict=True)):
            if tail.end is not None:
                self._travel.write_metres(cells, first, profile.zone_cost, ways)
                seconds[:, column] = (ways + tail.metres) / profile.speed + tail.acting
        return seconds
