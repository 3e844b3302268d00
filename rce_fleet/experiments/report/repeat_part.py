"""The part of the page that compares another full run with the first one."""

from __future__ import annotations

from math import isfinite, isnan
from typing import TYPE_CHECKING

from rce_fleet.experiments.report.labels import (
    DIGITS,
    factors_label,
    interval,
    scale_for,
    scaled,
    software_label,
    system_label,
)
from rce_fleet.experiments.report.repeat import GOAL, NEAR
from rce_fleet.experiments.report.tables import MISSING, folded, markdown
from rce_fleet.experiments.statistics import repeat_shares

if TYPE_CHECKING:
    from rce_fleet.experiments.report.repeat import Comparison, Pair

CHANCE = "by chance"
"""Column that tells whether chance alone can put a median there: whether it lies in the wider interval."""


def machine_text(first: float, second: float) -> str:
    """Return how fast the computer itself was in the second run; empty if one of them did not measure that.

    Args:
        first: Processor time of the same work in the first run, seconds.
        second: In the second run.
    """
    if isnan(first) or isnan(second):
        return ""
    scale = scale_for("s", [first])
    return (
        f"The computer itself did the same work in {scaled(first, scale)} {scale.unit} of processor time in "
        f"the first run and in {scaled(second, scale)} {scale.unit} in the second one "
        f"({100 * (second / first - 1):+.1f} %; medians of the rounds)."
    )


def comparison_text(comparison: Comparison) -> str:
    """Return how many medians of the second run lie in the first one's intervals, and which do not."""
    if not (comparison.pairs or comparison.constant):
        return "Nothing can be compared: no metric has an interval in both runs."
    parts = [_verdict(comparison), *filter(None, [_varying(comparison)]), _shares(comparison)]
    if comparison.outside:
        head = (
            "experiment",
            "system",
            "software",
            "factors",
            "metric",
            "first",
            "second",
            "unit",
            "change",
            CHANCE,
        )
        rows = [_row(pair) for pair in comparison.outside]
        parts.append(folded("Medians outside of the intervals", markdown(head, rows)))
    counts = {
        "have no interval in one of the runs": comparison.without_interval,
        "were measured in the first run only": len(comparison.only_first),
        "were measured in the second run only": len(comparison.only_second),
    }
    parts += [f"{count} metrics of conditions {what}." for what, count in counts.items() if count]
    return "\n\n".join(parts)


def _verdict(comparison: Comparison) -> str:
    reached = "reached" if comparison.reaches_goal else "not reached"
    text = (
        f"Of all {len(comparison.pairs) + len(comparison.constant)} medians of the second run, "
        f"{_percent(comparison.inside_of_all)} lie in the intervals of the first one; the goal of "
        f"{_percent(GOAL)} is {reached}. Numbers are compared as this page shows them, with {DIGITS} digits; "
        "values over time are not counted."
    )
    if not comparison.constant:
        return text
    return (
        f"{text} {len(comparison.constant)} of them are of metrics that had one value only in each run, such "
        f"as losses of 0: {comparison.same} of these have the same value in both."
    )


def _varying(comparison: Comparison) -> str:
    if not comparison.pairs:
        return ""
    by_chance = comparison.by_chance
    return (
        f"Of the {len(comparison.pairs)} medians of what varies, {_percent(comparison.inside)} lie in the "
        f"intervals, and with all digits {_percent(comparison.exactly_inside)}. If nothing differed but "
        f"chance, some {_percent(by_chance.estimate)} would, since the second medians vary too: "
        f"{_percent(repeat_shares(10, 10).estimate)} of those of ten runs, "
        f"{_percent(repeat_shares(3, 3).estimate)} of those of three. In intervals that allow for that, "
        "which are wider (with as many runs in both by the square root of 2), lie "
        f"{_percent(comparison.expected)}; by chance alone it would be some {_percent(by_chance.repeat)}. "
        f"In the first one's intervals, or outside by {_percent(NEAR)} of the first median at most, lie "
        f"{_percent(comparison.inside_or_near)}."
    )


def _shares(comparison: Comparison) -> str:
    rows = [
        (
            *(name, str(len(part.pairs))),
            *map(_percent, (part.inside, part.exactly_inside, part.by_chance.estimate)),
            *map(_percent, (part.expected, part.by_chance.repeat)),
            _percent(part.inside_or_near),
            f"{part.same} of {len(part.constant)}" if part.constant else MISSING,
        )
        for name, part in comparison.experiments()
    ]
    head = (
        *("experiment", "medians that vary", "in the intervals", "with all digits", "by chance alone"),
        *("in the wider ones", "by chance alone"),
        *(f"in the intervals, or outside by {_percent(NEAR)} at most", "constant, and the same"),
    )
    return markdown(head, rows)


def _row(pair: Pair) -> list[str]:
    condition, first, second = pair.first.condition, pair.first.estimate, pair.second.estimate
    scale = scale_for(pair.first.unit, [first.median])
    change = f"{100 * pair.change:+.1f} %" if isfinite(pair.change) else "from 0"
    return [
        *(condition.experiment, system_label(condition.system), software_label(condition.software)),
        *(factors_label(condition.factors), f"`{pair.first.metric}`"),
        *(interval(first, scale), interval(second, scale), scale.unit, change),
        "possible" if pair.is_expected else "unlikely",
    ]


def _percent(share: float) -> str:
    return MISSING if isnan(share) else f"{100 * share:.0f} %"
