"""Judges statements about systems by measured samples: pure, from samples to a verdict.

A *case* is a combination of factors in which the systems are compared. A claim is a list of expectations.
It holds in a case if all its expectations are met there. It holds if it holds in all cases, it does not
hold if it holds in none, and otherwise it depends on the factors.

Two systems are told apart if the intervals of their medians do not overlap and the medians differ by at least
5 %: with enough runs, differences can be told that no user would notice.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import isfinite, isnan
from typing import TYPE_CHECKING, Protocol

from rce_fleet.experiments.report.labels import COUNTS, SYSTEMS, factors_label, number, system_label
from rce_fleet.experiments.statistics import MIN_RUNS, effect_size

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rce_fleet.experiments.report.measurements import Quantity, Sample

MIN_RATIO = 1.05
"""Medians that differ by less are not called different."""
SAME_RATIO = 1.25
"""Medians that differ by at most this ratio are about the same."""


class Verdict(StrEnum):
    """What the measurements say about a claim."""

    HOLDS = "holds"
    FAILS = "does not hold"
    DEPENDS = "depends"
    NOT_MEASURED = "not measured"


@dataclass(frozen=True, slots=True)
class Check:
    """An expectation in a case.

    Attributes:
        text: What was expected: ``SMS above MMS``.
        quantity: What was compared.
        is_met: Whether it is so.
        pair: The two systems that were compared; empty if none were.
        effect: Their Cliff's delta.
    """

    text: str
    quantity: Quantity
    is_met: bool
    pair: tuple[str, str] | None = None
    effect: float = 0.0

    @property
    def name(self) -> str:
        """What was expected of what."""
        return f"{self.text} (`{self.quantity}`)"


@dataclass(frozen=True)
class Case:
    """A combination of factors, with the samples of the systems.

    Attributes:
        factors: Names and values.
        samples: By quantity, then by system.
        checks: The claim's expectations; empty if samples are missing.
        missing: What is missing: ``no rate of CRS``.
    """

    factors: tuple[tuple[str, str], ...]
    samples: Mapping[Quantity, Mapping[str, Sample]]
    checks: tuple[Check, ...] = ()
    missing: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether all expectations are met."""
        return bool(self.checks) and all(check.is_met for check in self.checks)

    @property
    def name(self) -> str:
        """The factors as text."""
        return factors_label(self.factors)


class MissingSampleError(LookupError):
    """A sample that an expectation needs was not measured, or in too few runs."""


class Expectation(Protocol):
    """What a claim says about the systems in one case."""

    @property
    def quantity(self) -> Quantity:
        """What it compares."""

    def check(self, find: Callable[[str, Quantity], Sample | None]) -> Check:
        """Return whether it is so.

        Raises:
            MissingSampleError: The samples do not suffice.
        """


@dataclass(frozen=True, slots=True)
class Above:
    """A system has more of a quantity than another one."""

    quantity: Quantity
    system: str
    other: str

    def check(self, find: Callable[[str, Quantity], Sample | None]) -> Check:
        """Compare the two."""
        mine, others = (needed(find, system, self.quantity) for system in (self.system, self.other))
        text = f"{system_label(self.system)} above {system_label(self.other)}"
        return compared(text, mine, others, is_met=is_above(mine, others))


@dataclass(frozen=True, slots=True)
class AboutSame:
    """A quantity is about the same in all systems."""

    quantity: Quantity
    systems: tuple[str, ...] = tuple(SYSTEMS)

    def check(self, find: Callable[[str, Quantity], Sample | None]) -> Check:
        """Compare the largest with the smallest."""
        samples = sorted(
            (needed(find, one, self.quantity) for one in self.systems), key=lambda one: one.median
        )
        least, most = samples[0], samples[-1]
        text = f"all within {100 * (SAME_RATIO - 1):.0f} %"
        return compared(text, most, least, is_met=ratio(most.median, least.median) <= SAME_RATIO)


@dataclass(frozen=True, slots=True)
class Between:
    """The median of a system lies in a range, both ends included."""

    quantity: Quantity
    system: str
    low: float
    high: float
    text: str

    def check(self, find: Callable[[str, Quantity], Sample | None]) -> Check:
        """Compare the median with the range."""
        median = needed(find, self.system, self.quantity).median
        return Check(self.text, self.quantity, self.low <= median <= self.high)


def needed(find: Callable[[str, Quantity], Sample | None], system: str, quantity: Quantity) -> Sample:
    """Return a sample that can be judged.

    Raises:
        MissingSampleError: It was not measured, or in too few runs for an interval.
    """
    sample = find(system, quantity)
    label = system_label(system)
    if sample is None:
        raise MissingSampleError(f"no `{quantity}` of {label}")
    if isnan(sample.estimate.low) and sample.unit not in COUNTS:
        runs = sample.estimate.runs
        raise MissingSampleError(f"`{quantity}` of {label} has {runs} of the {MIN_RUNS} runs that are needed")
    return sample


def is_above(mine: Sample, others: Sample) -> bool:
    """Return whether a sample is above another one, so that they can be told apart."""
    if mine.unit in COUNTS:
        return mine.median > others.median
    apart = mine.estimate.low > others.estimate.high
    return apart and mine.median >= MIN_RATIO * others.median


def compared(text: str, mine: Sample, others: Sample, *, is_met: bool) -> Check:
    """Return a check of two samples, with the size of the effect."""
    pair = (mine.condition.system, others.condition.system)
    return Check(text, mine.quantity, is_met, pair, effect_size(mine.values, others.values))


def ratio(most: float, least: float) -> float:
    """Return how many times the one is the other: 1 if both are 0."""
    if most == least:
        return 1.0
    return most / least if least else float("inf")


def verdict_of(cases: Sequence[Case]) -> Verdict:
    """Return the verdict of all cases that could be judged."""
    judged = [case.holds for case in cases if case.checks]
    if not judged:
        return Verdict.NOT_MEASURED
    if all(judged):
        return Verdict.HOLDS
    return Verdict.DEPENDS if any(judged) else Verdict.FAILS


def reason_of(cases: Sequence[Case]) -> str:
    """Say in words where the expectations are met, or what is missing."""
    judged = [case for case in cases if case.checks]
    if not judged:
        return _missing(cases)
    sentences = [_deciding_factor(judged) or _count(judged)]
    names = list(dict.fromkeys(check.name for case in judged for check in case.checks))
    counts = [_met(name, judged) for name in names]
    sentences.append(f"Met: {'; '.join(counts)}.")
    if unjudged := len(cases) - len(judged):
        sentences.append(f"Not judged, for missing systems or runs: {unjudged} more.")
    return " ".join(sentences)


def _missing(cases: Sequence[Case]) -> str:
    found = list(dict.fromkeys(text for case in cases for text in case.missing))
    if not found:
        return "No system was measured."
    more = f" and {len(found) - 3} more" if len(found) > 3 else ""  # noqa: PLR2004 - enough to see the cause
    return f"Missing: {', '.join(found[:3])}{more}."


def _count(judged: Sequence[Case]) -> str:
    holding = sum(case.holds for case in judged)
    return f"Holds in {holding} of {len(judged)} cases."


def _deciding_factor(judged: Sequence[Case]) -> str:
    """Name the factor that alone says where the claim holds; empty if there is none."""
    if len({case.holds for case in judged}) == 1:
        return ""
    for name in dict.fromkeys(name for case in judged for name, _ in case.factors):
        holding = [_factor(case, name) for case in judged if case.holds]
        failing = [_factor(case, name) for case in judged if not case.holds]
        if not set(holding) & set(failing):
            yes, no = (", ".join(dict.fromkeys(values)) for values in (holding, failing))
            return f"Depends on {name}: holds with {yes}, not with {no}."
    return ""


def _factor(case: Case, name: str) -> str:
    return dict(case.factors).get(name, "-")


def _met(name: str, judged: Sequence[Case]) -> str:
    checks = [check.is_met for case in judged for check in case.checks if check.name == name]
    return f"{name} {sum(checks)} of {len(checks)}"


def times(value: float) -> str:
    """Write a ratio: ``1.73 times``."""
    return f"{number(value) if isfinite(value) else '∞'} times"
