"""The part of the page about the paper's claims: one table of verdicts, then the cases of each claim."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.experiments.report.labels import (
    SYSTEMS,
    interval,
    scale_for,
    software_label,
    system_label,
)
from rce_fleet.experiments.report.tables import MISSING, folded, markdown

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rce_fleet.experiments.report.claims import Judgement
    from rce_fleet.experiments.report.judging import Case
    from rce_fleet.experiments.report.measurements import Quantity

NOT_JUDGED = "not judged"


def verdicts(judgements: Iterable[Judgement]) -> str:
    """Return the table of claims, with the figures of the case that is most like the paper's."""
    rows = [
        [
            f"({one.claim.letter}) {one.claim.text}",
            software_label(one.software),
            f"**{one.verdict}**",
            _figures(one),
            _effects(one.reference, _judged(one)),
            one.reason,
        ]
        for one in judgements
    ]
    return markdown(("claim", "software", "verdict", "figures", "Cliff's delta", "reason"), rows)


def cases(judgements: Sequence[Judgement]) -> str:
    """Return a table of the cases for each claim of which there are some."""
    parts = []
    for claim in {one.claim.letter: one.claim for one in judgements}.values():
        rows = [row for one in judgements if one.claim.letter == claim.letter for row in _rows(one)]
        if rows:
            head = ("software", "case", "quantity", *SYSTEMS.values(), "unit", "Cliff's delta", "met")
            title = f"({claim.letter}) {claim.text}: experiment `{claim.experiment}`"
            parts.append(folded(title, markdown(head, rows)))
    return "\n\n".join(parts)


def _rows(judgement: Judgement) -> list[list[str]]:
    judged = _judged(judgement)
    rows = []
    for case in judgement.cases:
        for quantity in judgement.claim.quantities:
            samples = case.samples.get(quantity, {})
            if not samples:
                continue
            scale = scale_for(next(iter(samples.values())).unit, (one.median for one in samples.values()))
            medians = (
                interval(samples[system].estimate, scale) if system in samples else MISSING
                for system in SYSTEMS
            )
            met = _met(case, quantity) if quantity in judged else MISSING
            about = (software_label(judgement.software), case.name, f"`{quantity}`")
            rows.append([*about, *medians, scale.unit or MISSING, _effects(case, [quantity]), met])
    return rows


def _figures(judgement: Judgement) -> str:
    case = judgement.reference
    if case is None:
        return MISSING
    parts = []
    for quantity in _judged(judgement):
        samples = case.samples[quantity]
        scale = scale_for(next(iter(samples.values())).unit, (one.median for one in samples.values()))
        medians = (
            f"{system_label(system)} {interval(samples[system].estimate, scale)}"
            for system in SYSTEMS
            if system in samples
        )
        parts.append(f"`{quantity}`: {', '.join(medians)} {scale.unit}".rstrip())
    return f"{'; '.join(parts)} ({case.name})"


def _effects(case: Case | None, quantities: Iterable[Quantity]) -> str:
    parts = []
    for quantity in quantities:
        found = ", ".join(
            f"{system_label(check.pair[0])}:{system_label(check.pair[1])} {check.effect:+.2f}"
            for check in (case.checks if case else ())
            if check.pair and check.quantity == quantity
        )
        if found:
            parts.append((quantity, found))
    if len(parts) > 1:
        return "; ".join(f"`{quantity}`: {found}" for quantity, found in parts)
    return parts[0][1] if parts else MISSING


def _met(case: Case, quantity: Quantity) -> str:
    if not case.checks:
        return NOT_JUDGED
    found = [check.is_met for check in case.checks if check.quantity == quantity]
    return f"{sum(found)} of {len(found)}"


def _judged(judgement: Judgement) -> list[Quantity]:
    return list(dict.fromkeys(expectation.quantity for expectation in judgement.claim.expectations))
