"""The order of runs: a warm-up of each condition, then rounds in random order."""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from rce_fleet.experiments.results import Condition

WARM_UP = 0
"""Number of the run that is not counted."""


class Run(NamedTuple):
    """One run of a condition."""

    condition: Condition
    number: int


def schedule(conditions: Sequence[Condition], runs: int, seed: int, *, warm_up: bool = True) -> list[Run]:
    """Return all runs in the order in which they are done.

    Each round has every condition once, in random order: what changes with time, such as the machine's
    temperature, then meets all conditions alike.

    Args:
        conditions: What is measured.
        runs: Runs of each condition that count.
        seed: Of the order.
        warm_up: Whether a round comes first that does not count.
    """
    random = Random(seed)  # noqa: S311 - not for secrets
    found = []
    for number in range(WARM_UP if warm_up else 1, runs + 1):
        found += [Run(condition, number) for condition in random.sample(list(conditions), len(conditions))]
    return found


def remaining(planned: Sequence[Run], done: Collection[Run]) -> list[Run]:
    """Return the planned runs that are not done yet; conditions with such runs are warmed up again."""
    missing = {run for run in planned if run.number != WARM_UP and run not in done}
    open_conditions = {run.condition for run in missing}
    return [
        run
        for run in planned
        if run in missing or (run.number == WARM_UP and run.condition in open_conditions)
    ]
