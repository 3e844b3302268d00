"""The problem that the search for better queues solves, as it is sent to the process that searches."""

from __future__ import annotations

from dataclasses import dataclass

LONGEST_S = 1e6
"""Seconds; what takes longer counts as impossible."""


@dataclass(frozen=True)
class RoutingProblem:
    """Which robot shall do which tasks, and in which order. Robots and tasks have numbers from 0 on.

    A place is where a robot begins, or where a task ends: the robots' places come first, then the tasks'.

    Attributes:
        ready: Seconds until each robot can begin, shape (robots,).
        profiles: Which table of ``seconds`` counts for each robot, shape (robots,).
        seconds: How long each task takes from each place, with the way to its first stop, for each profile,
            shape (profiles, robots + tasks, tasks). From :data:`LONGEST_S` on it cannot be done from there.
        queues: The tasks of each robot, in order.
        able: The robots that may do each task.
        weights: What a second counts until each task is done, shape (tasks,).
        deadlines: Seconds until each task should be done; ``inf``: at any time; shape (tasks,).
        late: What a second after the deadline counts in addition.
        length: Most tasks of a robot.
        keep: Seconds that must be saved, each with the task's weight, for a task that gets another robot.
    """

    ready: list[float]
    profiles: list[int]
    seconds: list[list[list[float]]]
    queues: list[list[int]]
    able: list[list[int]]
    weights: list[int]
    deadlines: list[float]
    late: float
    length: int
    keep: float

    def owners(self) -> dict[int, int]:
        """Return the robot in whose queue each task is."""
        return {task: robot for robot, queue in enumerate(self.queues) for task in queue}
