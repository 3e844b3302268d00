"""Why a claim holds or not, in words made from the figures of the cases that were judged."""

from __future__ import annotations

from math import inf, isfinite, log
from typing import TYPE_CHECKING

from rce_fleet.experiments.report.judging import MIN_RATIO, SAME_RATIO, ratio, times
from rce_fleet.experiments.report.labels import SYSTEMS, scale_for, scaled, system_label
from rce_fleet.experiments.report.measurements import Quantity

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rce_fleet.experiments.report.judging import Case
    from rce_fleet.experiments.report.measurements import Sample

SMS, MMS, CRS = SYSTEMS
NETWORK = Quantity("server.network_in", "+", "server.network_out")
MESSAGE = Quantity("message_bytes")
RATE = Quantity("rate")
RECEIVED = Quantity("received")
SERVER_CPU = Quantity("server.cpu")
CLIENT_CPU = Quantity("client.cpu")
# Cores for a message a second are the seconds of a core for a message; of each robot, where there are some.
SERVER_COST = Quantity("server.cpu", "/", "received", "s")
CLIENT_COST = Quantity("client.cpu", "/", "rate", "s")
ROUND_TRIP = Quantity("round_trip")
VISIBLE = Quantity("topics_visible")
OTHERS = Quantity("topics_others")
TOPICS, SERVICES, NEW_TOPICS = (Quantity(f"{what}_stopped") for what in ("topics", "services", "new_topics"))
LIMITED = "With client_cpu=full, it is limited to the same share of a core in all systems."
DOMINANT = 2.0
"""One of two causes makes the difference if its part is so much larger than the other one's."""


def explain_network(cases: Sequence[Case], reference: Case) -> str:
    """Say whether the rate or the size of messages makes the difference in machine 1's network."""
    del cases
    return _cause(reference, NETWORK, RECEIVED, MESSAGE)


def explain_client(cases: Sequence[Case], reference: Case) -> str:
    """Say whether the rate or the cost of a message makes the difference in machine 2's CPU."""
    limited = any(("client_cpu", "full") in case.factors for case in cases)
    texts = (LIMITED if limited else "", _cause(reference, CLIENT_CPU, RATE, CLIENT_COST))
    return " ".join(filter(None, texts))


def explain_server(cases: Sequence[Case], reference: Case) -> str:
    """Say whether the rate or the cost of a message makes the difference in machine 1's CPU."""
    del cases
    return _cause(reference, SERVER_CPU, RECEIVED, SERVER_COST)


def explain_both(cases: Sequence[Case], reference: Case) -> str:
    """Explain the CPU of both machines."""
    texts = (explain_server(cases, reference), explain_client(cases, reference))
    return " ".join(filter(None, texts))


def explain_server_and_network(cases: Sequence[Case], reference: Case) -> str:
    """Explain CPU and network of machine 1."""
    texts = (explain_server(cases, reference), explain_network(cases, reference))
    return " ".join(filter(None, texts))


def explain_rate(cases: Sequence[Case], reference: Case) -> str:
    """Say what a scan costs machine 2: with a full CPU the rate is what this cost leaves."""
    del cases
    costs, used = reference.samples.get(CLIENT_COST, {}), reference.samples.get(CLIENT_CPU, {})
    if not costs or not used:
        return ""
    figures = f"Machine 2 uses {medians(used)}, and for a message of each robot {medians(costs)} of CPU time"
    if _spread(used) <= SAME_RATIO:
        return f"{figures}: it uses about the same, so the rate is what its CPU allows."
    return f"{figures}: it does not use the same, so its CPU is not all that limits the rate."


def explain_round_trip(cases: Sequence[Case], reference: Case) -> str:
    """Say at which sizes the systems differ most and least."""
    del reference
    found = [
        (_spread(samples), case)
        for case in cases
        if len(samples := case.samples.get(ROUND_TRIP, {})) == len(SYSTEMS)
    ]
    if not found:
        return ""
    most, least = max(found, key=lambda pair: pair[0]), min(found, key=lambda pair: pair[0])
    return " ".join(
        f"The systems differ {word} with {case.name}, {times(spread)}: {medians(case.samples[ROUND_TRIP])}."
        for word, (spread, case) in (("most", most), ("least", least))
    )


def explain_counts(cases: Sequence[Case], reference: Case) -> str:
    """Say how many topics of other robots a robot sees."""
    del cases
    seen = reference.samples.get(OTHERS, {})
    return f"Topics of other robots that a robot sees: {medians(seen)}." if seen else ""


def explain_stops(cases: Sequence[Case], reference: Case) -> str:
    """Say how long topics, services and new topics stopped in each system."""
    del reference
    words = ((TOPICS, "connected topics"), (SERVICES, "services"), (NEW_TOPICS, "new topics"))
    sentences = []
    for quantity, name in words:
        samples = {
            system: sample for case in cases for system, sample in case.samples.get(quantity, {}).items()
        }
        if samples:
            sentences.append(f"{name} stopped for {medians(samples)}")
    text = "; ".join(sentences)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def medians(samples: Mapping[str, Sample]) -> str:
    """Return the medians of systems with their unit: ``SMS 7.50, MMS 4.50, CRS 4.00 Hz``."""
    scale = scale_for(next(iter(samples.values())).unit, (sample.median for sample in samples.values()))
    texts = (
        f"{system_label(system)} {scaled(samples[system].median, scale)}"
        for system in (*SYSTEMS, *sorted(samples.keys() - SYSTEMS.keys()))
        if system in samples
    )
    return f"{', '.join(texts)} {scale.unit}".rstrip()


def _cause(case: Case, total: Quantity, rate: Quantity, each: Quantity) -> str:
    """Say which of two factors makes the difference between the systems with most and least of a total."""
    found = [case.samples.get(quantity, {}) for quantity in (total, rate, each)]
    systems = [system for system in SYSTEMS if all(system in samples for samples in found)]
    if len(systems) < 2:  # noqa: PLR2004 - a comparison
        return ""
    totals, rates, costs = found
    most = max(systems, key=lambda system: totals[system].median)
    least = min(systems, key=lambda system: totals[system].median)
    total_ratio, rate_ratio, cost_ratio = (
        ratio(samples[most].median, samples[least].median) for samples in found
    )
    figures = f"`{rate}`: {medians(rates)}; `{each}`: {medians(costs)}."
    if total_ratio < MIN_RATIO:
        return f"`{total}` does not differ by more than 5 %. {figures}"
    labels = f"{system_label(most)} and {system_label(least)}"
    return (
        f"Of `{total}`, {labels} have most and least, {times(total_ratio)}: `{rate}` differs "
        f"{times(rate_ratio)}, `{each}` {times(cost_ratio)}, so {_blame(rate_ratio, cost_ratio)}. {figures}"
    )


def _blame(rate_ratio: float, cost_ratio: float) -> str:
    # What differs by less than systems that can be told apart makes no difference.
    rate, cost = (
        0.0 if abs(value) < log(MIN_RATIO) else value for value in map(_log, (rate_ratio, cost_ratio))
    )
    if rate > DOMINANT * max(cost, 0.0):
        return "more messages make the difference" if cost >= 0 else "more messages outweigh cheaper ones"
    if cost > DOMINANT * max(rate, 0.0):
        return "each message costs more" if rate >= 0 else "each message costs more, though there are fewer"
    return "the number of messages and the cost of each both make the difference"


def _log(value: float) -> float:
    return log(value) if value > 0 and isfinite(value) else (inf if value else -inf)


def _spread(samples: Mapping[str, Sample]) -> float:
    found = [sample.median for sample in samples.values()]
    return ratio(max(found), min(found))
