"""Draws panels: lines over time or a factor, bars, points."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.experiments.report.drawing import add_legend, errors, look_of
from rce_fleet.experiments.report.labels import SYSTEMS, Scale, scale_for, system_label

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rce_fleet.experiments.report.panels import Panel


def draw_over_time(panels: Sequence[Panel], axes: Sequence[Axes], figure: Figure) -> None:
    """Draw a line with a band for each system over the seconds."""
    scale = _common_scale(panels)
    for panel, plane in zip(panels, axes, strict=True):
        for series in panel.series:
            seconds = [float(place) for place, _ in series.points]
            below, above = errors(series.samples, scale.factor)
            medians = [sample.median / scale.factor for sample in series.samples]
            look = series.look
            plane.plot(seconds, medians, look.line, color=look.colour, label=series.label, linewidth=1.4)
            plane.fill_between(
                seconds,
                [median - part for median, part in zip(medians, below, strict=True)],
                [median + part for median, part in zip(medians, above, strict=True)],
                color=look.colour,
                alpha=0.2,
                linewidth=0,
            )
        plane.set(title=panel.title, xlabel="s", ylabel=scale.unit, ylim=(0, None))
    add_legend(figure, axes)


def draw_cpu(panels: Sequence[Panel], axes: Sequence[Axes], figure: Figure) -> None:
    """Draw two bars for each system, one of each machine."""
    del figure
    looks = {system_label(system): look_of(system) for system in SYSTEMS}
    for panel, plane in zip(panels, axes, strict=True):
        bars = sorted(
            ((name, sample, series.look.hatch) for series in panel.series for name, sample in series.points),
            key=lambda bar: list(looks).index(bar[0].partition("-")[0]),
        )
        for place, (name, sample, hatch) in enumerate(bars):
            plane.bar(
                place,
                sample.median,
                color=looks[name.partition("-")[0]].colour,
                hatch=hatch,
                edgecolor="white",
                yerr=[[length[0]] for length in errors([sample], 1.0)],
                ecolor="black",
            )
        plane.set_xticks(range(len(bars)), [name for name, _, _ in bars], fontsize=6.5)
        plane.set(title=panel.title, ylabel="cores", ylim=(0, None))


def draw_lines(
    panels: Sequence[Panel], axes: Sequence[Axes], figure: Figure, *, is_log: bool, across: str
) -> None:
    """Draw lines over a factor."""
    for panel, plane in zip(panels, axes, strict=True):
        scale = _common_scale([panel])
        for series in panel.series:
            look = series.look
            plane.errorbar(
                [float(place) for place, _ in series.points],
                [sample.median / scale.factor for sample in series.samples],
                yerr=errors(series.samples, scale.factor),
                fmt=look.line,
                color=look.colour,
                marker=look.marker,
                label=series.label,
                linewidth=1.3,
            )
        plane.set(title=panel.title, xlabel=across, ylabel=scale.unit)
        if is_log and all(sample.median > 0 for sample in panel.samples):
            plane.set(xscale="log", yscale="log")
        else:
            plane.set_ylim(bottom=0)
    add_legend(figure, axes)


def draw_bars(panels: Sequence[Panel], axes: Sequence[Axes], figure: Figure) -> None:
    """Draw bars of the systems beside each other, at each place."""
    for panel, plane in zip(panels, axes, strict=True):
        scale = _common_scale([panel])
        places = list(dict.fromkeys(place for series in panel.series for place, _ in series.points))
        width = 0.8 / len(panel.series)
        for nth, series in enumerate(panel.series):
            at = [places.index(place) - 0.4 + (nth + 0.5) * width for place, _ in series.points]
            medians = [sample.median / scale.factor for sample in series.samples]
            plane.bar(
                at,
                medians,
                width,
                color=series.look.colour,
                hatch=series.look.hatch,
                edgecolor="white",
                yerr=errors(series.samples, scale.factor),
                ecolor="black",
                label=series.label,
            )
            for (place, _), across, median in zip(series.points, at, medians, strict=True):
                if place in series.marked:
                    plane.text(across, median, "x", ha="center", va="bottom")
        plane.set_xticks(range(len(places)), places, fontsize=7)
        plane.set(title=panel.title, ylabel=scale.unit, ylim=(0, None))
    add_legend(figure, axes)


def draw_points(panels: Sequence[Panel], axes: Sequence[Axes], figure: Figure) -> None:
    """Draw points of the systems beside each other, at each place, on a logarithmic axis.

    Bars need an axis from zero, which a logarithmic one does not have.
    """
    for panel, plane in zip(panels, axes, strict=True):
        scale = _common_scale([panel])
        places = list(dict.fromkeys(place for series in panel.series for place, _ in series.points))
        for nth, series in enumerate(panel.series):
            beside = 0.2 * (nth - (len(panel.series) - 1) / 2)
            plane.errorbar(
                [places.index(place) + beside for place, _ in series.points],
                [sample.median / scale.factor for sample in series.samples],
                yerr=errors(series.samples, scale.factor),
                fmt=series.look.marker,
                color=series.look.colour,
                label=series.label,
            )
        plane.set_xticks(range(len(places)), places, fontsize=7)
        plane.set(title=panel.title, ylabel=scale.unit, xlim=(-0.5, len(places) - 0.5))
        if all(sample.median > 0 for sample in panel.samples):
            plane.set_yscale("log")
    add_legend(figure, axes)


def _common_scale(panels: Sequence[Panel]) -> Scale:
    """Return a unit in which the largest value has few digits."""
    samples = [sample for panel in panels for sample in panel.samples]
    return scale_for(samples[0].unit, [max(sample.median for sample in samples)])
