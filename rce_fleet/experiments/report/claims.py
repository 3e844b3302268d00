"""The paper's claims, and what the measurements say about each, for each software by itself."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

from rce_fleet.experiments.report import explanations
from rce_fleet.experiments.report.explanations import CRS, MMS, SMS
from rce_fleet.experiments.report.judging import (
    AboutSame,
    Above,
    Between,
    Case,
    Check,
    Expectation,
    MissingSampleError,
    Verdict,
    is_above,
    needed,
    reason_of,
    verdict_of,
)
from rce_fleet.experiments.report.labels import SOFTWARE, SYSTEMS, USUAL, natural, system_label

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rce_fleet.experiments.report.measurements import Measurements, Quantity, Sample
    from rce_fleet.experiments.results import Condition

    Factors = tuple[tuple[str, str], ...]

STOPPED_S = 1.0
"""Without an answer for longer, something has stopped."""
NEAR_SHARE = 0.25
"""A rate is the paper's if it differs by this share at most."""
FROM_CONTAINER = "server (CRS: container)"
"""Origin of messages from machine 1: in CRS from a container, in the others from its only graph."""


def by_factors(condition: Condition) -> list[Factors]:
    """Compare systems that have the same factors."""
    return [condition.factors]


def by_origin(condition: Condition) -> list[Factors]:
    """Compare messages from a container of CRS, too, with messages from machine 1 of the others."""
    factors = dict(condition.factors)
    origins = {
        "server": ["server"] if condition.system == CRS else ["server", FROM_CONTAINER],
        "container": [FROM_CONTAINER],
    }
    origin = factors.get("origin", "")
    return [
        tuple((name, one if name == "origin" else value) for name, value in condition.factors)
        for one in origins.get(origin, [origin])
    ]


def by_system(condition: Condition) -> list[Factors]:
    """Judge each system by itself."""
    return [(("system", system_label(condition.system)), *condition.factors)]


def as_it_is(cases: list[Case]) -> list[Case]:
    """Return the cases as they are."""
    return cases


def growing(cases: list[Case]) -> list[Case]:
    """Add to each case whether the round trip grows with the size, its other factors being the same."""
    groups: dict[Factors, list[Case]] = defaultdict(list)
    for case in cases:
        groups[_without_size(case)].append(case)
    checks = {group: _growth(found) for group, found in groups.items()}
    return [
        replace(case, checks=(*case.checks, *checks[_without_size(case)]))
        if case.checks and checks[_without_size(case)]
        else replace(case, checks=(), missing=(*case.missing, "other sizes"))
        for case in cases
    ]


@dataclass(frozen=True)
class Claim:
    """A statement of the paper that is judged.

    Attributes:
        letter: Its letter in the table.
        text: What the paper says.
        experiment: The experiment that judges it.
        expectations: What it says about a case.
        explain: Makes the reason from the cases and the one nearest to the paper's.
        also: Quantities that the reason needs and that are not judged.
        where: Factors of the cases that count.
        like_paper: Factors of the case that is shown in the table of claims.
        arrange: Gives the cases in which a condition is compared.
        refine: Changes all cases at last.
    """

    letter: str
    text: str
    experiment: str
    expectations: tuple[Expectation, ...]
    explain: Callable[[Sequence[Case], Case], str]
    also: tuple[Quantity, ...] = ()
    where: Mapping[str, str] = field(default_factory=dict)
    like_paper: Mapping[str, str] = field(default_factory=dict)
    arrange: Callable[[Condition], list[Factors]] = by_factors
    refine: Callable[[list[Case]], list[Case]] = as_it_is

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What is shown for each case: what is judged first."""
        judged = (expectation.quantity for expectation in self.expectations)
        return tuple(dict.fromkeys((*judged, *self.also)))


@dataclass(frozen=True)
class Judgement:
    """What the measurements with one software say about a claim.

    Attributes:
        claim: The claim.
        software: The software.
        verdict: The verdict.
        reason: Why, in words.
        cases: All cases, also those that could not be judged.
        reference: The case nearest to the paper's that was judged, if there is one.
    """

    claim: Claim
    software: str
    verdict: Verdict
    reason: str
    cases: tuple[Case, ...]
    reference: Case | None


def judge(claim: Claim, measurements: Measurements, software: str) -> Judgement:
    """Judge a claim by the rows of one software."""
    arranged: dict[Factors, dict[str, Condition]] = defaultdict(dict)
    for condition in measurements.conditions(claim.experiment):
        if condition.software == software and claim.where.items() <= dict(condition.factors).items():
            for factors in claim.arrange(condition):
                arranged[factors][condition.system] = condition
    cases = [_case(claim, measurements, *item) for item in arranged.items()]
    cases = claim.refine(cases)
    reference = _reference(claim, cases)
    reason = reason_of(cases)
    if reference is not None:
        reason = f"{reason} {claim.explain(cases, reference)}".rstrip()
    elif not cases:
        reason = _nothing(claim)
    return Judgement(claim, software, verdict_of(cases), reason, tuple(cases), reference)


def judge_all(measurements: Measurements) -> list[Judgement]:
    """Judge all claims for the usual software, and for other software that was measured in two systems."""
    systems: dict[str, set[str]] = defaultdict(set)
    for condition in measurements.runs:
        systems[condition.software].add(condition.system)
    compared = {software for software, found in systems.items() if len(found & SYSTEMS.keys()) > 1}
    known = [software for software in SOFTWARE if software in compared.union(USUAL)]
    known += sorted(compared.difference(SOFTWARE))
    return [judge(claim, measurements, software) for claim in CLAIMS for software in known]


def _case(
    claim: Claim, measurements: Measurements, factors: Factors, conditions: Mapping[str, Condition]
) -> Case:
    samples = {
        quantity: {
            system: sample
            for system, condition in conditions.items()
            if (sample := measurements.sample(condition, quantity))
        }
        for quantity in claim.quantities
    }

    def find(system: str, quantity: Quantity) -> Sample | None:
        if not system:  # each system is a case of its own
            (system,) = conditions
        return samples[quantity].get(system)

    checks, missing = [], []
    for expectation in claim.expectations:
        try:
            checks.append(expectation.check(find))
        except MissingSampleError as error:
            missing.append(str(error))
    return Case(factors, samples, () if missing else tuple(checks), tuple(dict.fromkeys(missing)))


def _reference(claim: Claim, cases: Iterable[Case]) -> Case | None:
    judged = [case for case in cases if case.checks]
    return max(
        judged,
        key=lambda case: len(claim.like_paper.items() & dict(case.factors).items()),
        default=None,
    )


def _nothing(claim: Claim) -> str:
    only = ", ".join(f"{name}={value}" for name, value in claim.where.items())
    return f"No rows of `{claim.experiment}`{f' with {only}' if only else ''}."


def _without_size(case: Case) -> Factors:
    return tuple((name, value) for name, value in case.factors if name != "bytes")


def _growth(cases: Sequence[Case]) -> list[Check]:
    """Check for each system that the largest size takes longest, and none takes less than a smaller one."""
    ordered = sorted(cases, key=lambda case: natural(dict(case.factors).get("bytes", "")))
    if len(ordered) < 2:  # noqa: PLR2004 - a smaller and a larger one
        return []
    checks = []
    for system in SYSTEMS:
        try:
            samples = [needed(_finder(one), system, ROUND_TRIP) for one in ordered]
        except MissingSampleError:
            return []
        grows = is_above(samples[-1], samples[0])
        shrinks = any(is_above(smaller, larger) for smaller, larger in pairwise(samples))
        text = f"{system_label(system)} grows with size"
        checks.append(Check(text, ROUND_TRIP, grows and not shrinks))
    return checks


def _finder(case: Case) -> Callable[[str, Quantity], Sample | None]:
    return lambda system, quantity: case.samples[quantity].get(system)


NETWORK, MESSAGE, RATE, RECEIVED, ROUND_TRIP = (
    explanations.NETWORK,
    explanations.MESSAGE,
    explanations.RATE,
    explanations.RECEIVED,
    explanations.ROUND_TRIP,
)
SERVER_CPU, CLIENT_CPU = explanations.SERVER_CPU, explanations.CLIENT_CPU
SERVER_COST, CLIENT_COST = explanations.SERVER_COST, explanations.CLIENT_COST
_LASER = {"printed": "yes", "client_cpu": "full", "rate": "free"}
_IMAGES = {"size": "640x480", "encoding": "raw", "printed": "yes", "rate": "carried"}
_PAPER_RATES = {SMS: 7.5, MMS: 4.5, CRS: 4.0}

CLAIMS = (
    Claim(
        "a",
        "SMS makes the most traffic at machine 1, CRS the least",
        "laser",
        (Above(NETWORK, SMS, MMS), Above(NETWORK, SMS, CRS), Above(NETWORK, MMS, CRS)),
        explanations.explain_network,
        also=(RECEIVED, MESSAGE),
        like_paper=_LASER,
    ),
    Claim(
        "b",
        "Clients publish at 7.5 Hz in SMS, 4.5 Hz in MMS, 4 Hz in CRS",
        "laser",
        (
            Above(RATE, SMS, MMS),
            Above(RATE, MMS, CRS),
            *(
                Between(
                    RATE,
                    system,
                    (1 - NEAR_SHARE) * rate,
                    (1 + NEAR_SHARE) * rate,
                    f"{system_label(system)} within {100 * NEAR_SHARE:.0f} % of {rate:g} Hz",
                )
                for system, rate in _PAPER_RATES.items()
            ),
        ),
        explanations.explain_rate,
        also=(CLIENT_CPU, CLIENT_COST),
        where={"client_cpu": "full", "rate": "free"},
        like_paper=_LASER,
    ),
    Claim(
        "c",
        "The client's CPU is lowest in SMS, higher in MMS and CRS for their additional processes",
        "laser",
        (Above(CLIENT_CPU, MMS, SMS), Above(CLIENT_CPU, CRS, SMS)),
        explanations.explain_client,
        also=(RATE, CLIENT_COST),
        like_paper=_LASER | {"client_cpu": "all"},  # a full client's CPU is limited, to the same in all
    ),
    Claim(
        "d",
        "The server's CPU and network are highest in SMS",
        "laser",
        tuple(Above(quantity, SMS, other) for quantity in (SERVER_CPU, NETWORK) for other in (MMS, CRS)),
        explanations.explain_server_and_network,
        also=(RECEIVED, SERVER_COST, MESSAGE),
        like_paper=_LASER,
    ),
    Claim(
        "e",
        "The round trip grows with size and is about the same in all three",
        "round-trip",
        (AboutSame(ROUND_TRIP),),
        explanations.explain_round_trip,
        like_paper={"bytes": "100000", "delay": "0", "origin": FROM_CONTAINER},
        arrange=by_origin,
        refine=growing,
    ),
    Claim(
        "f",
        "For images, the network is about the same in all three",
        "images",
        (AboutSame(NETWORK),),
        explanations.explain_network,
        also=(RECEIVED, MESSAGE),
        like_paper=_IMAGES,
    ),
    Claim(
        "g",
        "For images, CPU is highest in CRS on both sides, then MMS, then SMS",
        "images",
        tuple(
            Above(quantity, more, less)
            for quantity in (SERVER_CPU, CLIENT_CPU)
            for more, less in ((CRS, MMS), (MMS, SMS))
        ),
        explanations.explain_both,
        also=(RECEIVED, SERVER_COST, RATE, CLIENT_COST),
        like_paper=_IMAGES,
    ),
    Claim(
        "h",
        "With one master, topics are visible to all; with several, only what is shared",
        "isolation",
        (
            Between(explanations.OTHERS, SMS, 1, float("inf"), "SMS shows topics of others"),
            *(
                Between(explanations.OTHERS, system, 0, 0, f"{system_label(system)} shows none of others")
                for system in (MMS, CRS)
            ),
        ),
        explanations.explain_counts,
        also=(explanations.VISIBLE,),
    ),
    Claim(
        "i",
        "Topics that are connected outlive a dead roscore; services and new topics do not",
        "robustness",
        (
            Between(explanations.TOPICS, "", 0, STOPPED_S, f"topics stop for {STOPPED_S:g} s at most"),
            *(
                Between(quantity, "", STOPPED_S, float("inf"), f"{name} stop for {STOPPED_S:g} s at least")
                for quantity, name in (
                    (explanations.SERVICES, "services"),
                    (explanations.NEW_TOPICS, "new topics"),
                )
            ),
        ),
        explanations.explain_stops,
        where={"fault": "core_killed"},
        like_paper={"system": "SMS"},
        arrange=by_system,
    ),
)
