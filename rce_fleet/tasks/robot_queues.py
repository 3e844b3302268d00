"""What robots do after their present tasks: the queues in the book, and when robots are at them."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

from rce_fleet.tasks.assignment import FreeRobot, misfit
from rce_fleet.tasks.batches import LATEST_S, is_plannable
from rce_fleet.tasks.energy import effort_of, seconds_to_fill, share_needed
from rce_fleet.tasks.order import Action
from rce_fleet.tasks.queueing import Queues, RobotQueue
from rce_fleet.tasks.records import AUTOMATIC
from rce_fleet.tasks.routing_problem import LONGEST_S
from rce_fleet.tasks.task import TaskCause, TaskState

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from rce_fleet.tasks.batches import Batch
    from rce_fleet.tasks.book import TaskBook
    from rce_fleet.tasks.energy import Effort
    from rce_fleet.tasks.facts import RobotFacts
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
        full: Share of the full battery with which a robot leaves a charger.
    """

    def __init__(
        self,
        book: TaskBook,
        travel: TravelCosts,
        profile: Callable[[str], RobotProfile],
        length: int,
        full: float,
    ) -> None:
        self._book = book
        self._travel = travel
        self._profile = profile
        self._queues = Queues(travel, length)
        self._full = full

    def begin_step(self) -> None:
        """Forget how long tasks take: the map may be another one."""
        self._queues.begin_step()

    def left(self, task: Task, robot: RobotFacts, now: float) -> tuple[float, int | None]:
        """Return how many seconds of a task are left to a robot that does it, and where the robot is then.

        Args:
            task: The task.
            robot: The robot.
            now: Seconds since 1970.

        Returns:
            Seconds, ``inf`` if no way leads to all stops; the cell of the last stop, None if no stop has one.
        """
        profile, stop, visit = self._profile(robot.id), task.next_stop, task.action
        effort = effort_of(task, robot.cell or 0, self._travel, profile)
        acted = min(now - visit.started_at, stop.duration) if visit is not None and stop is not None else 0.0
        charging = seconds_to_fill(task, robot.battery, profile, self._full)
        return max(0.0, effort.seconds(profile) - acted) + charging, effort.end

    def until_done(self, task: Task, now: float, robot: RobotFacts) -> float:
        """Return in how many seconds a robot will have done a task in its queue.

        Returns:
            ``inf`` if it cannot, or the task is not in its queue any more.
        """
        queue = self._queue_of(robot, now)
        queue.tasks = [each for each in queue.tasks if each.number <= task.number]
        return self._queues.finish(queue) if task.number in (each.number for each in queue.tasks) else inf

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

    def is_busy(self, robot: RobotFacts) -> bool:
        """Return whether a robot does a task."""
        present = self._book.task_of(robot.id)
        return robot.is_there and present is not None and present.state is TaskState.RUNNING

    def busy(self, now: float, robots: Iterable[RobotFacts]) -> list[RobotQueue]:
        """Return the queues, empty ones too, of those robots that do a task whose end is known."""
        queues = (self._queue_of(robot, now) for robot in robots if self.is_busy(robot))
        return [queue for queue in queues if queue.ready < inf]

    def takes_part(self, robot: RobotFacts) -> bool:
        """Return whether the queue of a robot may be improved: it drives, and its tasks can be planned."""
        present = self._book.task_of(robot.id)
        drives = robot.is_driven and not robot.by_hand and self._book.entry(robot.id).mode == AUTOMATIC
        if present is None or not drives or not self.is_busy(robot):
            return False
        return is_plannable(present) and all(map(is_plannable, self._book.queue_of(robot.id)))

    def improvable(self, now: float, robots: Iterable[RobotFacts]) -> list[RobotQueue]:
        """Return the queues of robots that take part and can do all that is in their queues."""
        return [queue for queue in self.busy(now, robots) if self._queues.finish(queue) < LONGEST_S]

    def fill(
        self,
        tasks: Sequence[Task],
        queues: Sequence[RobotQueue],
        now: float,
        avoided: Collection[tuple[int, str]],
        robots: Mapping[str, RobotFacts],
        lack_of_energy: Callable[[Task, FreeRobot, Effort], str],
    ) -> None:
        """Put tasks into queues; note it in the book.

        Args:
            tasks: Tasks without a robot, the most urgent first.
            queues: Of busy robots.
            now: Seconds since 1970.
            avoided: Numbers of tasks with robots that gave them up a short time ago.
            robots: What is known of the robots, by name.
            lack_of_energy: See :meth:`~rce_fleet.tasks.assignment.Assigner.lack_of_energy`.
        """
        batteries: dict[str, float | None] = {}

        def lacks_energy(task: Task, queue: RobotQueue) -> bool:
            name, cell, profile = queue.robot, queue.cell, queue.profile
            if name not in batteries:
                batteries[name] = self._battery_after(robots[name])
            if batteries[name] is None:
                return False
            effort = effort_of(task, cell, self._travel, profile, in_metres=True)
            return bool(lack_of_energy(task, FreeRobot(name, cell, profile, batteries[name]), effort))

        for task, name in self._queues.insert(tasks, queues, avoided, lacks_energy):
            text = f"{task.id} is in the queue of {name}"
            self._book.advance(task, TaskCause.ASSIGN, now, text, robot=name)

    def adopt(
        self,
        batch: Batch,
        routes: Sequence[Sequence[int]],
        now: float,
        robots: Mapping[str, RobotFacts],
        avoided: Collection[tuple[int, str]],
        weak: Collection[str],
    ) -> None:
        """Give tasks to the queues of other robots: all of them, or none if something has changed since.

        Args:
            batch: What the routes were found for.
            routes: The tasks of each robot, by their numbers in the batch's problem.
            now: Seconds since 1970.
            robots: What is known of the robots, by name.
            avoided: Numbers of tasks with robots that gave them up a short time ago.
            weak: Robots that get no tasks of others, because their batteries are low.
        """
        if now - batch.made_at > LATEST_S or self._travel.version != batch.map_version:
            return
        moves = batch.moves(routes)
        for name in {name for move in moves for name in (move.source, move.target)}:
            robot, present = robots.get(name), self._book.task_of(name)
            if robot is None or present is None or not self.takes_part(robot):
                return
            if not batch.is_still(name, present.number, self._book.queue_of(name)):
                return
        tasks = [self._book.tasks[move.task] for move in moves]
        for task, move in zip(tasks, moves, strict=True):
            if move.target in weak or (task.number, move.target) in avoided:
                return
            if misfit(task, move.target, self._profile(move.target)):
                return
        for task, move in zip(tasks, moves, strict=True):
            text = f"moved from {move.source} to {move.target}: the queued tasks together are done earlier"
            self._book.advance(task, TaskCause.ASSIGN, now, text, robot=move.target)

    def _battery_after(self, robot: RobotFacts) -> float | None:
        """Return the share of a robot's battery that its present task leaves; None: not known."""
        task, profile = self._book.task_of(robot.id), self._profile(robot.id)
        if robot.battery is None or robot.cell is None or task is None:
            return None
        left = (task.order.stop(number) for number in range(task.position, task.order.length))
        if any(stop.action is Action.CHARGE for stop in left):
            return None
        effort = effort_of(task, robot.cell, self._travel, profile, in_metres=True)
        return max(0.0, robot.battery - share_needed(effort, profile))

    def _queue_of(self, robot: RobotFacts, now: float) -> RobotQueue:
        """Return a robot's queue, which it begins with when its present task ends."""
        profile, task = self._profile(robot.id), self._book.task_of(robot.id)
        cell = robot.cell if robot.cell is not None else 0
        queued = self._book.queue_of(robot.id)
        if task is None:
            return RobotQueue(robot.id, profile, cell, 0.0, queued)
        left, end = self.left(task, robot, now)
        return RobotQueue(robot.id, profile, cell if end is None else end, left, queued)
