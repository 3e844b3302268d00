"""Throughput, waiting times, utilization and batteries of the fleet."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

from rce_fleet.api.fleet import StatisticsModel
from rce_fleet.tasks.task import TaskState

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_fleet.tasks.book import TaskBook
    from rce_fleet.tasks.facts import FleetFacts

BUCKET_S = 60.0
BUCKETS = 24 * 60
"""A day of minutes is kept."""


@dataclass(slots=True)
class Minute:
    """Robots' seconds of one minute.

    Attributes:
        began: When it began, seconds since 1970.
        busy: Seconds with a task, of all robots.
        all: Seconds in service, of all robots.
    """

    began: float
    busy: float = 0.0
    all: float = 0.0


class FleetStatistics:
    """Counts what cannot be computed from tasks later.

    Args:
        now: Seconds since 1970.
        before: Minutes that a journal kept, the oldest first.
    """

    def __init__(self, now: float, before: Iterable[Minute] = ()) -> None:
        self._last = now
        self._minutes: deque[Minute] = deque([*before, Minute(now)], BUCKETS)

    def skip(self, seconds: float) -> None:
        """Leave out a step of the clock since the last call: no robot did anything in it.

        Args:
            seconds: By which it was set forward.
        """
        self._last += seconds

    def update(self, now: float, facts: FleetFacts, book: TaskBook) -> Minute | None:
        """Add the time since the last call; return the minute that has ended, if one has."""
        passed, self._last = max(0.0, now - self._last), now
        ended = None
        if now - self._minutes[-1].began >= BUCKET_S:
            ended = self._minutes[-1]
            self._minutes.append(Minute(now))
        minute = self._minutes[-1]
        for robot in facts.robots.values():
            if robot.is_there and not book.entry(robot.id).is_out:
                minute.all += passed
                minute.busy += passed * (book.task_of(robot.id) is not None)
        return ended

    def show(
        self, now: float, seconds: float, facts: FleetFacts, book: TaskBook, known_since: float = -inf
    ) -> StatisticsModel:
        """Return the figures of the last seconds.

        Args:
            now: Seconds since 1970.
            seconds: Length of the time; it is shorter in the figures if tasks of it were forgotten.
            facts: The robots.
            book: The tasks.
            known_since: From when on no task that has ended was forgotten, seconds since 1970.
        """
        since = max(now - seconds, min(known_since, now - 1.0))
        seconds = now - since
        ended = [task for task in book.tasks.values() if task.has_ended and task.changed_at > since]
        done = [task for task in ended if task.state is TaskState.DONE]
        waits = [task.started_at - task.created_at for task in done if task.started_at is not None]
        lasts = [task.changed_at - task.started_at for task in done if task.started_at is not None]
        minutes = [minute for minute in self._minutes if minute.began + BUCKET_S >= since]
        total = sum(minute.all for minute in minutes)
        batteries = [robot.battery for robot in facts.robots.values() if robot.battery is not None]
        return StatisticsModel(
            seconds=seconds,
            tasks_done=len(done),
            tasks_failed=sum(task.state is TaskState.FAILED for task in ended),
            tasks_cancelled=sum(task.state is TaskState.CANCELLED for task in ended),
            tasks_open=book.open_count,
            tasks_per_hour=len(done) * 3600 / seconds,
            waiting_s=_mean(waits),
            duration_s=_mean(lasts),
            late=sum(task.late for task in ended),
            utilization=sum(minute.busy for minute in minutes) / total if total else None,
            robots=sum(1 for robot in facts.robots.values() if not book.entry(robot.id).is_out),
            battery_mean=_mean(batteries),
            battery_least=min(batteries, default=None),
        )


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None
