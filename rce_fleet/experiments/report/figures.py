"""The figures of the page: which can be drawn from the measurements."""

from __future__ import annotations

from collections import defaultdict
from functools import partial
from typing import TYPE_CHECKING

from rce_fleet.experiments.report.drawing import Drawing, Look, look_of
from rce_fleet.experiments.report.explanations import NETWORK
from rce_fleet.experiments.report.labels import SYSTEMS, number, software_label, system_label
from rce_fleet.experiments.report.measurements import Quantity
from rce_fleet.experiments.report.panels import Panel, Series, cases, image_panels, panels_over
from rce_fleet.experiments.report.plots import draw_bars, draw_cpu, draw_lines, draw_over_time, draw_points

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rce_fleet.experiments.report.measurements import Measurements, Sample
    from rce_fleet.experiments.results import Condition

OVER_TIME = "server.network@"
MACHINES = (("server", "S", ""), ("client", "C", "///"))
"""Machines with the letter of their bars, and the hatch that tells them apart."""


def figures_of(measurements: Measurements) -> dict[str, list[Drawing]]:
    """Return the figures that can be drawn, by experiment."""
    found: dict[str, list[Drawing]] = defaultdict(list)
    for experiment, make in _FIGURES:
        present = {condition.software: None for condition in measurements.conditions(experiment)}
        for software in present:
            if drawing := make(measurements, software):
                found[experiment].append(drawing)
    return found


def network_over_time(measurements: Measurements, software: str) -> Drawing | None:
    """Return the figure of machine 1's network over time: a line for each system."""
    times = sorted(
        (metric for metric in measurements.metrics("laser") if metric.startswith(OVER_TIME)), key=_seconds
    )
    panels = [
        Panel(
            title,
            tuple(
                Series(system_label(system), look_of(system), tuple(points))
                for system, condition in conditions.items()
                if (points := _points(measurements, condition, times))
            ),
        )
        for title, conditions in cases(measurements, "laser", software)
    ]
    caption = "Network of machine 1 over time, in and out (median, 95 % interval as a band)"
    return _figure("laser-network", caption, software, panels, draw_over_time)


def laser_cpu(measurements: Measurements, software: str) -> Drawing | None:
    """Return the paper's figure of CPU: two bars for each system, with the rate at which clients publish."""
    panels = [
        Panel(title, _bars(measurements, conditions))
        for title, conditions in cases(measurements, "laser", software)
    ]
    caption = (
        "CPU of machine 1 (S, server) and machine 2 (C, client) in cores, "
        "with the rate at which each robot publishes"
    )
    return _figure("laser-cpu", caption, software, panels, draw_cpu)


def round_trips(measurements: Measurements, software: str) -> Drawing | None:
    """Return the figure of the round trip over the message's size, both logarithmic."""
    panels = panels_over(
        measurements,
        "round-trip",
        software,
        "bytes",
        Quantity("round_trip"),
        moved={("origin", "container"): ("origin", "server")},
    )
    caption = "Round trip over the size of the message"
    draw = partial(draw_lines, is_log=True, across="bytes")
    return _figure("round-trip", caption, software, panels, draw, columns=2)


def images_cpu(measurements: Measurements, software: str) -> Drawing | None:
    """Return the figure of both machines' CPU for images."""
    quantities = tuple(Quantity(f"{machine}.cpu") for machine, _, _ in MACHINES)
    panels = image_panels(measurements, software, quantities)
    caption = "CPU for images in cores, of machine 1 (server) and machine 2 (client)"
    return _figure("images-cpu", caption, software, panels, draw_bars, columns=1, panel=(8.4, 2.8))


def images_network(measurements: Measurements, software: str) -> Drawing | None:
    """Return the figure of machine 1's network for images."""
    panels = image_panels(measurements, software, (NETWORK,))
    caption = "Network of machine 1 for images, in and out, on a logarithmic axis"
    return _figure("images-network", caption, software, panels, draw_points, columns=1, panel=(8.4, 3.0))


def scaling(measurements: Measurements, software: str) -> Drawing | None:
    """Return the figure of what changes with the number of robots."""
    panels = [
        Panel(f"{quantity}{f', {panel.title}' if panel.title else ''}", panel.series)
        for quantity in map(
            Quantity, ("received", "delay_p95", "lost", "server.cpu", "server.memory", "round_trip", "start")
        )
        for panel in panels_over(measurements, "scaling", software, "robots", quantity, ("containers",))
    ]
    draw = partial(draw_lines, is_log=False, across="robots")
    return _figure("scaling", "What changes with the number of robots", software, panels, draw)


def stops(measurements: Measurements, software: str) -> Drawing | None:
    """Return the figure of how long topics, services and new topics stop after a fault."""
    panels = [
        Panel(title, tuple(_stopped(measurements, condition) for condition in conditions.values()))
        for title, conditions in cases(measurements, "robustness", software)
    ]
    caption = "Time for which topics, services and new topics stopped after a fault (x: did not come back)"
    return _figure("robustness", caption, software, panels, draw_bars)


def _stopped(measurements: Measurements, condition: Condition) -> Series:
    points, lost = [], set()
    for name in ("topics", "services", "new_topics"):
        place = name.replace("_", " ")
        back = measurements.sample(condition, f"{name}_came_back")
        if sample := measurements.sample(condition, f"{name}_stopped"):
            points.append((place, sample))
            lost |= {place} if back and not back.median else set()
    system = condition.system
    return Series(system_label(system), look_of(system), tuple(points), frozenset(lost))


def offload(measurements: Measurements, software: str) -> Drawing | None:
    """Return the figure of a task's time over the link's rate, on the robot and in the cloud."""
    panels = panels_over(measurements, "offload", software, "rate", Quantity("task_time"), ("place",))
    draw = partial(draw_lines, is_log=True, across="rate in Mbit/s")
    return _figure("offload", "Time of a task over the link's rate", software, panels, draw, columns=3)


_FIGURES: tuple[tuple[str, Callable[[Measurements, str], Drawing | None]], ...] = (
    ("laser", network_over_time),
    ("laser", laser_cpu),
    ("round-trip", round_trips),
    ("images", images_network),
    ("images", images_cpu),
    ("scaling", scaling),
    ("robustness", stops),
    ("offload", offload),
)


def _figure(
    name: str,
    caption: str,
    software: str,
    panels: Iterable[Panel],
    draw: Callable[[Sequence[Panel], Sequence[Axes], Figure], None],
    *,
    columns: int = 4,
    panel: tuple[float, float] = (3.3, 2.6),
) -> Drawing | None:
    shown = [one for one in panels if one.samples]
    if not shown:
        return None
    suffix = "" if software == "-" else f"-{software}"
    about = "" if software == "-" else f"; software: {software_label(software)}"
    return Drawing(f"{name}{suffix}", f"{caption}{about}", partial(draw, shown), len(shown), columns, panel)


def _bars(measurements: Measurements, conditions: Mapping[str, Condition]) -> tuple[Series, ...]:
    """Return two bars for each system; the points' names carry the rates."""
    found = []
    for machine, letter, hatch in MACHINES:
        points = []
        for system in SYSTEMS:
            condition = conditions.get(system)
            sample = measurements.sample(condition, f"{machine}.cpu") if condition else None
            if condition and sample:
                rate = measurements.sample(condition, "rate")
                shown = f"\n{number(rate.median)} Hz" if rate else ""
                points.append((f"{system_label(system)}-{letter}{shown if letter == 'C' else ''}", sample))
        if points:
            found.append(Series(machine, Look("", "", "", hatch), tuple(points)))
    return tuple(found)


def _points(
    measurements: Measurements, condition: Condition, metrics: Sequence[str]
) -> list[tuple[str, Sample]]:
    samples = ((metric, measurements.sample(condition, metric)) for metric in metrics)
    return [(metric.removeprefix(OVER_TIME), sample) for metric, sample in samples if sample]


def _seconds(metric: str) -> float:
    return float(metric.removeprefix(OVER_TIME))
