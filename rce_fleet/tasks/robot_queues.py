"""What robots do after their present tasks: the queues in the book, and when robots are at them."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

from rce_fleet.tasks.energy import effort_of
from rce_fleet.tasks.queueing import Queues, RobotQueue
from rce_fleet.tasks.task import TaskCause, TaskState

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from rce_fleet.tasks.book import TaskBook
    from rce_fleet.tasks.facts import FleetFacts, RobotFacts
    from rce_fleet.tasks.records import RobotProfile
    from rce_fleet.tasks.task import Task
    from rce_fleet.tasks.travel import TravelCosts


class RobotQueues:
    """The queues of the robots of a fleet.

    Args:
        book: The tasks.
        travel: Distances.
        profile: Returns what a robot can do.
        length: Most tasks in a queue.
    """

    def __init__(
        self, book: TaskBook, travel: TravelCosts, profile: Callable[[str], RobotProfile], length: int
    ) -> None:
        self._book = book
        self._travel = travel
        self._profile = profile
        self._queues = Queues(travel, length)

    def begin_step(self) -> None:
        """Forget how long tasks take: the map may be another one."""
        self._queues.begin_step()

    def left(self, task: Task, cell: int, profile: RobotProfile, now: float) -> tuple[float, int | None]:
        """Return how many seconds of a task are left to a robot that does it, and where the robot is then.

        Args:
            task: The task.
            cell: Where the robot is.
            profile: The robot's.
            now: Seconds since 1970.

        Returns:
            Seconds, ``inf`` if no way leads to all stops; the cell of the last stop, None if no stop has one.
        """
        effort = effort_of(task, cell, self._travel, profile)
        acted = now - task.action.started_at if task.action is not None else 0.0
        return max(0.0, effort.seconds(profile) - acted), effort.end

    def until_done(self, task: Task, now: float, robot: RobotFacts) -> float:
        """Return in how many seconds a robot will have done a task in its queue; ``inf`` if it cannot."""
        queue = self._queue_of(robot, now)
        numbers = [each.number for each in queue.tasks]
        del queue.tasks[numbers.index(task.number) + 1 :]
        return self._queues.finish(queue)

    def begins(self, task: Task, now: float, robot: RobotFacts | None, working: Collection[str]) -> float:
        """Return in how many seconds the robot in whose queue a task is will be at its first stop.

        Args:
            task: The task.
            now: Seconds since 1970.
            robot: The robot; None: it is not known.
            working: Robots without a task that can be given one.

        Returns:
            ``inf`` if it is not known: the robot does not drive now, or gets no task before it has charged.
        """
        if robot is None or not robot.is_driven or robot.by_hand or robot.cell is None:
            return inf
        present = self._book.task_of(robot.id)
        if robot.id not in working and (present is None or present.state is not TaskState.RUNNING):
            return inf
        return self._queues.begin(self._queue_of(robot, now), task)

    def busy(self, now: float, facts: FleetFacts) -> list[RobotQueue]:
        """Return the queues, empty ones too, of robots that do a task whose end is known."""
        queues = []
        for robot in facts.robots.values():
            present = self._book.task_of(robot.id)
            if robot.is_there and present is not None and present.state is TaskState.RUNNING:
                queue = self._queue_of(robot, now)
                if queue.ready < inf:
                    queues.append(queue)
        return queues

    def fill(
        self,
        tasks: Sequence[Task],
        queues: Sequence[RobotQueue],
        now: float,
        avoided: Collection[tuple[int, str]],
    ) -> None:
        """Put tasks into queues; note it in the book.

        Args:
            tasks: Tasks without a robot, the most urgent first.
            queues: Of busy robots.
            now: Seconds since 1970.
            avoided: Numbers of tasks with robots that gave them up a short time ago.
        """
        for task, name in self._queues.insert(tasks, queues, avoided):
            text = f"{task.id} is in the queue of {name}"
            self._book.advance(task, TaskCause.ASSIGN, now, text, robot=name)

    def _queue_of(self, robot: RobotFacts, now: float) -> RobotQueue:
        """Return a robot's queue, which it begins with when its present task ends."""
        profile, task = self._profile(robot.id), self._book.task_of(robot.id)
        cell = robot.cell if robot.cell is not None else 0
        queued = self._book.queue_of(robot.id)
        if task is None:
            return RobotQueue(robot.id, profile, cell, 0.0, queued)
        left, end = self.left(task, cell, profile, now)
        return RobotQueue(robot.id, profile, cell if end is None else end, left, queued)
