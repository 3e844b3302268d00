"""Rows of raw data whose medians are known by hand. They are invented: no page of the project has them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rce_fleet.experiments.report.labels import SYSTEMS
from rce_fleet.experiments.results import Condition, Row

SPREAD = (0.99, 1.0, 1.01)
"""Three runs, whose median is the middle one and whose interval ends at the others."""
SMS, MMS, CRS = SYSTEMS


def rows_of(
    condition: Condition, values: Mapping[str, tuple[float, str]], spread: Iterable[float] = SPREAD
) -> list[Row]:
    """Return the runs of a condition, from medians and units by metric."""
    return [
        Row(condition, run, metric, median * share, unit)
        for run, share in enumerate(spread, 1)
        for metric, (median, unit) in values.items()
    ]


def in_three_systems(
    experiment: str,
    metric: str,
    unit: str,
    medians: tuple[float, float, float],
    factors: Mapping[str, object] | None = None,
    *,
    software: str = "ros",
    spread: Iterable[float] = SPREAD,
) -> list[Row]:
    """Return the runs of a metric in SMS, MMS and CRS."""
    return [
        row
        for system, median in zip(SYSTEMS, medians, strict=True)
        for row in rows_of(
            Condition.of(experiment, system, software, **(factors or {})), {metric: (median, unit)}, spread
        )
    ]


def example_rows(software: Iterable[str] = ("ros", "rce"), spread: Iterable[float] = SPREAD) -> list[Row]:
    """Return rows of every experiment, as a full run has them but with fewer values of the factors."""
    spread = tuple(spread)
    found = [row for name in software for make in _EXAMPLES for row in make(name, spread)]
    link = {"round_trip": (0.0021, "s"), "round_trip_p99": (0.004, "s")}
    link |= {"rate": (2.4e7, "bit/s"), "rate_back": (2.3e7, "bit/s")}
    found += rows_of(Condition.of("link", "-", "-", delay=0), {**link, "lost": (0.0, "share")}, spread)
    return found + rows_of(Condition.of("machine", "-", "-", round=1), {"work": (0.05, "s")}, spread)


def _traffic(rate: float, message: float, share: float) -> dict[str, tuple[float, str]]:
    """Return the metrics of `laser` and `images`, the same for all robots but in different systems."""
    network = {
        f"{machine}.network_{way}": (5 * rate * message / 2, "B/s")
        for machine in ("server", "client")
        for way in ("in", "out")
    }
    cpu = {"server.cpu": (0.02 * rate * share, "cores"), "client.cpu": (0.04 * rate * share, "cores")}
    delays = {f"delay_p{part}": (0.001 * part * share, "s") for part in (50, 95, 99)}
    counts = {"rate": (rate, "Hz"), "received": (rate, "Hz"), "lost": (0.01 * share, "share")}
    rest = {
        "message_bytes": (message, "B"),
        "link.cpu": (0.05, "cores"),
        "server.memory": (9e7 * share, "B"),
        "client.memory": (3e8, "B"),
    }
    return {**network, **cpu, **delays, **counts, **rest}


def _laser(software: str, spread: tuple[float, ...]) -> list[Row]:
    found = []
    for system, rate, share in zip(SYSTEMS, (7.5, 4.5, 4.0), (1.0, 1.5, 1.7), strict=True):
        for client_cpu in ("all", "full"):
            for how in ("free", "fixed"):
                true_rate = 4.0 if how == "fixed" else rate * (4 if client_cpu == "all" else 1)
                condition = Condition.of(
                    "laser", system, software, robots=5, printed="yes", client_cpu=client_cpu, rate=how
                )
                times = {
                    f"server.network@{step / 2}": (true_rate * 2600 * (0.9 + 0.02 * step), "B/s")
                    for step in range(8)
                }
                found += rows_of(condition, {**_traffic(true_rate, 2600.0, share), **times}, spread)
    return found


def _round_trip(software: str, spread: tuple[float, ...]) -> list[Row]:
    found = []
    for system, share in zip(SYSTEMS, (1.0, 1.1, 1.4), strict=True):
        for size in (7, 1000, 1_000_000):
            for origin in ("server", "client", *(["container"] if system == CRS else [])):
                seconds = share * (0.001 + size / 2.5e6)
                condition = Condition.of("round-trip", system, software, bytes=size, delay=0, origin=origin)
                metrics = {
                    "round_trip": (seconds, "s"),
                    "round_trip_p95": (2 * seconds, "s"),
                    "lost": (0.0, "share"),
                }
                found += rows_of(condition, metrics, spread)
    return found


def _images(software: str, spread: tuple[float, ...]) -> list[Row]:
    return [
        row
        for system, share in zip(SYSTEMS, (1.0, 1.1, 1.6), strict=True)
        for size, pixels in (("160x120", 19_200), ("640x480", 307_200))
        for encoding, bytes_each in (("raw", 3.0), ("jpeg", 0.2))
        for row in rows_of(
            Condition.of(
                "images", system, software, size=size, encoding=encoding, rate="carried", printed="no"
            ),
            _traffic(2.0, pixels * bytes_each * share, share),
            spread,
        )
    ]


def _others(software: str, spread: tuple[float, ...]) -> list[Row]:
    """Rows of scaling, robustness, isolation, offload and configuration."""
    found = []
    for system, share in zip(SYSTEMS, (1.0, 1.2, 1.5), strict=True):
        for robots in (1, 10):
            factors = {"robots": robots, "containers": "one"} if system == CRS else {"robots": robots}
            more = {"round_trip": (0.002 * share * robots, "s"), "start": (0.5 * robots * share, "s")}
            condition = Condition.of("scaling", system, software, **factors)
            found += rows_of(condition, {**_traffic(30.0 / robots, 2600.0, share), **more}, spread)
        stops = {
            "topics_stopped": (0.1 * share, "s"),
            "services_stopped": (20.0, "s"),
            "services_came_back": (0.0, ""),
            "new_topics_stopped": (20.0, "s"),
        }
        found += rows_of(
            Condition.of("robustness", system, software, fault="core_killed"),
            {**stops, "lost_messages": (3 * share, "count")},
            spread,
        )
        seen = {
            "topics_visible": (12.0, "count"),
            "topics_others": (8.0 if system == SMS else 0.0, "count"),
            "can_publish": (1.0, ""),
        }
        found += rows_of(Condition.of("isolation", system, software), seen, (1.0,) * len(spread))
        files = {"files_to_add": (1.0, "count"), "lines_to_add": (12.0, "count")}
        found += rows_of(Condition.of("configuration", system, software), files, (1.0,))
    for place, seconds in (("robot", 9.0), ("cloud", 4.0)):
        for rate in (1, 10):
            condition = Condition.of("offload", CRS, software, place=place, task="amcl", rate=rate, delay=5)
            found += rows_of(
                condition,
                {"task_time": (seconds / (rate if place == "cloud" else 1), "s"), "energy": (20.0, "J")},
                spread,
            )
    return found


_EXAMPLES = (_laser, _round_trip, _images, _others)
