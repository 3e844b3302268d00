"""With how many robots a system breaks, and what breaks first.

What counts as broken is declared here. Each symptom compares a median with that of the fewest robots, or with
a limit.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce_fleet.experiments.report.labels import natural, software_label, system_label
from rce_fleet.experiments.report.tables import MISSING, folded, markdown

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rce_fleet.experiments.report.measurements import Measurements
    from rce_fleet.experiments.results import Condition

    Medians = Mapping[str, float]
    """Medians by metric, of a condition."""

KEPT = 0.9
"""Share of the rate that a working system keeps."""
MOST_LOST = 0.01
"""Share of the messages that a working system may lose."""
LATE_S, TIMES_LATER = 0.1, 3.0
"""A delay breaks a system if it is longer than the first, and so many times that of the fewest robots."""
ACROSS = "robots"


@dataclass(frozen=True, slots=True)
class Symptom:
    """A way in which a system breaks.

    Attributes:
        text: What happens.
        metrics: The metrics that tell it.
        shows: Whether it is so, from the medians with some robots and with the fewest.
    """

    text: str
    metrics: tuple[str, ...]
    shows: Callable[[Medians, Medians], bool]


SYMPTOMS = (
    Symptom("robots publish less", ("rate",), lambda now, first: now["rate"] < KEPT * first["rate"]),
    Symptom(
        "messages arrive more slowly than they are published",
        ("received", "rate"),
        lambda now, _: now["received"] < KEPT * now["rate"],
    ),
    Symptom("messages are lost", ("lost",), lambda now, _: now["lost"] > MOST_LOST),
    Symptom(
        "messages come late",
        ("delay_p95",),
        lambda now, first: now["delay_p95"] > max(LATE_S, TIMES_LATER * first["delay_p95"]),
    ),
)


def breaking_table(measurements: Measurements, experiment: str) -> str:
    """Return a table with the number of robots at which each system breaks, and what breaks."""
    groups: dict[tuple[str, str, tuple[tuple[str, str], ...]], list[Condition]] = defaultdict(list)
    for condition in measurements.conditions(experiment):
        kept = tuple(pair for pair in condition.factors if pair[0] != ACROSS)
        if len(kept) < len(condition.factors):
            groups[condition.system, condition.software, kept].append(condition)
    rows = []
    for (system, software, kept), conditions in groups.items():
        ordered = sorted(conditions, key=lambda one: natural(_robots(one)))
        medians = {_robots(one): _medians(measurements, one) for one in ordered}
        robots, texts = first_symptoms(medians)
        about = ", ".join(f"{name}={value}" for name, value in kept) or MISSING
        reason = "; ".join(texts) or f"nothing up to {list(medians)[-1]}"
        rows.append([system_label(system), software_label(software), about, robots or MISSING, reason])
    if not rows:
        return ""
    head = ("system", "software", "factors", "breaks with robots", "what breaks first")
    return f"{folded('What breaks first', markdown(head, rows))}\n\n{_RULES}"


def first_symptoms(medians: Mapping[str, Medians]) -> tuple[str, Sequence[str]]:
    """Return the lowest number of robots with a symptom, and all that show there.

    Args:
        medians: By the number of robots, the fewest first.
    """
    found = list(medians.items())
    for robots, now in found:
        first = found[0][1]
        texts = [
            f"{symptom.text} ({', '.join(f'`{metric}`' for metric in symptom.metrics)})"
            for symptom in SYMPTOMS
            if all(metric in now and metric in first for metric in symptom.metrics)
            and symptom.shows(now, first)
        ]
        if texts:
            return robots, texts
    return "", []


_RULES = (
    f"A system breaks if robots publish at less than {100 * KEPT:.0f} % of the rate with the fewest "
    f"robots, if less than {100 * KEPT:.0f} % of what they publish arrives, if more than "
    f"{100 * MOST_LOST:.0f} % of the messages are lost, or if `delay_p95` is above {1000 * LATE_S:.0f} ms "
    f"and {TIMES_LATER:g} times that with the fewest robots."
)


def _medians(measurements: Measurements, condition: Condition) -> dict[str, float]:
    metrics = {metric for symptom in SYMPTOMS for metric in symptom.metrics}
    samples = ((metric, measurements.sample(condition, metric)) for metric in metrics)
    return {metric: sample.median for metric, sample in samples if sample}


def _robots(condition: Condition) -> str:
    return dict(condition.factors)[ACROSS]
