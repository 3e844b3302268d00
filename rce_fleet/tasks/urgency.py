"""Orders tasks by their urgency, many at once.

:meth:`rce_fleet.tasks.assignment.Assigner.urgency` says of one task what it is worth to begin with it. With
ten thousand tasks that wait, a call for each would hold the manager for tens of milliseconds in each step.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.limits import MOST_LATE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rce_fleet.tasks.assignment import AssignmentRules
    from rce_fleet.tasks.task import Task


def urgencies(tasks: Sequence[Task], now: float, rules: AssignmentRules) -> NDArray[np.float64]:
    """Return what it is worth to begin with each task now, in seconds of way, shape (tasks,).

    Args:
        tasks: The tasks.
        now: Seconds since 1970.
        rules: What counts.
    """
    orders = [task.order for task in tasks]
    made = np.array([task.created_at for task in tasks], np.float64)
    starts = np.array([order.earliest_start or 0.0 for order in orders], np.float64)
    ages = np.clip(now - np.maximum(made, starts), 0.0, MOST_LATE)
    worth = np.array([order.priority for order in orders], np.float64) * rules.priority + ages * rules.age
    deadlines = np.array([inf if order.deadline is None else order.deadline for order in orders], np.float64)
    left = deadlines - now  # infinite without a deadline, which adds nothing then
    worth += np.clip(rules.deadline_window - left, 0.0, MOST_LATE) * rules.deadline
    return worth


def most_urgent_first(tasks: Sequence[Task], now: float, rules: AssignmentRules) -> list[Task]:
    """Return tasks in the order of their urgency; of equal ones the oldest first.

    Args:
        tasks: The tasks.
        now: Seconds since 1970.
        rules: What counts.
    """
    numbers = np.array([task.number for task in tasks], np.int64)
    order = np.lexsort((numbers, -urgencies(tasks, now, rules)))
    return [tasks[place] for place in order.tolist()]
