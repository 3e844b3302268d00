"""Compares two full runs: which medians of the second one lie in the intervals of the first one.

Two runs of the same thing do not agree in 95 % of the medians: an interval contains the true median in 95 of
100 experiments, but the second run's median varies too. How many lie in the interval depends on the number of
runs (:func:`~rce_fleet.experiments.statistics.repeat_shares`): some 83 % of large samples, 87 % of ten, whose
intervals are a little wide, and 60 % of three.
Source: G. Cumming, R. Maillardet, "Confidence intervals and replication: Where will the next mean fall?",
2006. Therefore two more shares are counted: of medians in the wider intervals in which another run's median
is expected (:meth:`~rce_fleet.experiments.statistics.Estimate.for_repeat`), and of those that are outside by
little.

Numbers are compared as the page shows them, with three significant digits: memory that differs by a few
pages between two runs is not another result. Shares by chance are about all digits; therefore it is also
counted how many medians lie in the intervals with all digits.

Metrics that have one value only within each of the two runs, such as losses of 0, agree or do not, and no
chance is in it. The goal is about all medians; shares by chance, and of each experiment, are about those that
vary.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan, nan
from statistics import median
from typing import TYPE_CHECKING

from rce_fleet.experiments.report.labels import condition_order, scale_for, scaled
from rce_fleet.experiments.results import MACHINE, WORK
from rce_fleet.experiments.statistics import RepeatShares, repeat_shares

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rce_fleet.experiments.report.summary import Summary

GOAL = 0.9
"""Share of the medians that must lie in the first run's intervals."""
NEAR = 0.05
"""A median outside of the interval is near if it differs from the first one by this share at most."""


@dataclass(frozen=True, slots=True)
class Pair:
    """A metric of a condition in two runs."""

    first: Summary
    second: Summary

    @property
    def is_inside(self) -> bool:
        """Whether the second median lies in the first one's interval, as the page shows both."""
        first = self.first.estimate
        scale = scale_for(self.first.unit, [first.median])
        median, low, high = (
            float(scaled(value, scale)) for value in (self.second.estimate.median, first.low, first.high)
        )
        return low <= median <= high

    @property
    def is_exactly_inside(self) -> bool:
        """The same with all digits of both."""
        return self.second.estimate.median in self.first.estimate

    @property
    def is_expected(self) -> bool:
        """Whether the second median lies where it is expected if nothing differs but chance."""
        return self.second.estimate.median in self.first.estimate.for_repeat(self.second.estimate.runs)

    @property
    def change(self) -> float:
        """The second median's difference from the first one, as a share of the first one."""
        first, second = self.first.estimate.median, self.second.estimate.median
        if first == second:
            return 0.0
        return (second - first) / abs(first) if first else float("inf")

    @property
    def is_constant(self) -> bool:
        """Whether no interval has a width: neither run says how far medians vary."""
        return all(one.estimate.low == one.estimate.high for one in (self.first, self.second))

    @property
    def is_near(self) -> bool:
        """Whether the second median is outside of the interval by little."""
        return not self.is_inside and abs(self.change) <= NEAR


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two full runs.

    Attributes:
        pairs: What both measured, with an interval, and varied in a run.
        constant: The same of what did not vary in either run.
        without_interval: Metrics that both measured, in one of them with too few runs for an interval.
        only_first: Metrics of conditions that the second one did not measure.
        only_second: Those that the first one did not measure.
    """

    pairs: tuple[Pair, ...]
    constant: tuple[Pair, ...]
    without_interval: int
    only_first: tuple[Summary, ...]
    only_second: tuple[Summary, ...]

    @property
    def inside(self) -> float:
        """Share of the second medians that lie in the first one's intervals, of what varied."""
        return self._share(pair.is_inside for pair in self.pairs)

    @property
    def exactly_inside(self) -> float:
        """The same with all digits."""
        return self._share(pair.is_exactly_inside for pair in self.pairs)

    @property
    def inside_of_all(self) -> float:
        """The same share of all medians, also of what did not vary."""
        both = (*self.pairs, *self.constant)
        return sum(pair.is_inside for pair in both) / len(both) if both else nan

    @property
    def expected(self) -> float:
        """Share of those that lie in the wider intervals of a repeat."""
        return self._share(pair.is_expected for pair in self.pairs)

    @property
    def inside_or_near(self) -> float:
        """Share of those that lie in the intervals, or outside by little."""
        return self._share(pair.is_inside or pair.is_near for pair in self.pairs)

    @property
    def by_chance(self) -> RepeatShares:
        """Shares that lie in the two kinds of intervals if nothing differs but chance."""
        shares = [repeat_shares(pair.first.estimate.runs, pair.second.estimate.runs) for pair in self.pairs]
        return RepeatShares(
            self._share(one.estimate for one in shares), self._share(one.repeat for one in shares)
        )

    @property
    def same(self) -> int:
        """How many of those that did not vary have the same value in both runs."""
        return sum(pair.is_inside for pair in self.constant)

    @property
    def reaches_goal(self) -> bool:
        """Whether enough of all medians lie in the intervals."""
        return self.inside_of_all >= GOAL

    @property
    def outside(self) -> list[Pair]:
        """What does not lie in the intervals, the largest change first."""
        found = (pair for pair in (*self.pairs, *self.constant) if not pair.is_inside)
        return sorted(found, key=lambda pair: -abs(pair.change))

    def _share(self, counted: Iterable[float]) -> float:
        return sum(counted) / len(self.pairs) if self.pairs else nan

    def experiments(self) -> Iterator[tuple[str, Comparison]]:
        """Yield the comparison of each experiment by itself."""
        both = (*self.pairs, *self.constant)
        for name in sorted({pair.first.condition.experiment for pair in both}):
            pairs, constant = (
                tuple(pair for pair in found if pair.first.condition.experiment == name)
                for found in (self.pairs, self.constant)
            )
            yield name, Comparison(pairs, constant, 0, (), ())


def compare(first: Iterable[Summary], second: Iterable[Summary]) -> Comparison:
    """Compare two full runs by their summaries; metrics over time (``name@seconds``) do not count.

    Numbers of both are rounded as in the file of a summary, so that a committed one can be compared.
    """
    one, other = _by_name(first), _by_name(second)
    both = [Pair(found, other[name]) for name, found in one.items() if name in other]
    pairs = tuple(
        pair for pair in both if not (isnan(pair.first.estimate.low) or isnan(pair.second.estimate.low))
    )
    return Comparison(
        tuple(pair for pair in pairs if not pair.is_constant),
        tuple(pair for pair in pairs if pair.is_constant),
        len(both) - len(pairs),
        tuple(found for name, found in one.items() if name not in other),
        tuple(found for name, found in other.items() if name not in one),
    )


def machine_work(summaries: Iterable[Summary]) -> float:
    """Return the processor time of the computer's work, seconds: the median of the rounds; NaN: none."""
    found = [one.estimate.median for one in summaries if _is_machine(one) and one.metric == WORK]
    return median(found) if found else nan


def _is_machine(summary: Summary) -> bool:
    return summary.condition.experiment == MACHINE


def _by_name(summaries: Iterable[Summary]) -> dict[object, Summary]:
    kept = (one for one in summaries if "@" not in one.metric and not _is_machine(one))
    ordered = sorted(kept, key=lambda one: (condition_order(one.condition), one.metric))
    return {(one.condition, one.metric): one for one in ordered}
