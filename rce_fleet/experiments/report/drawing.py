"""How all figures look, and how they are written as PNG and SVG: the same files from the same data.

Systems differ by colour, marker, line and hatch, so that colour is never the only sign. The colours can be
told apart by people who see no red or no green. Source: M. Okabe, K. Ito, "Color Universal Design", 2008.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from math import ceil, isnan
from typing import TYPE_CHECKING, Any, NamedTuple

from rce_fleet.experiments.report.labels import SYSTEMS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rce_fleet.experiments.report.measurements import Sample

MISSING = "matplotlib is not installed: pip install 'rce[figures]'"
PANEL = (3.3, 2.6)
"""Width and height of a panel in inches."""
DPI = 110
_LETTERS, _HANDLE = 15, 9
"""Letters of a legend in an inch, and as how many a line and the space beside it count."""
INK = "#333333"
_SALT = "rce experiment"
"""Seed of the names of an SVG's parts, which are random otherwise."""
_STYLE: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": INK,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 9,
    "errorbar.capsize": 2.5,
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "grid.alpha": 0.3,
    "hatch.linewidth": 0.6,
    "lines.markersize": 4.5,
    "svg.fonttype": "none",  # labels stay text, which can be searched
    "svg.hashsalt": _SALT,
}


class Look(NamedTuple):
    """How a line or a bar is drawn."""

    colour: str
    marker: str
    line: str
    hatch: str


LOOKS = dict(
    zip(
        SYSTEMS,
        (Look("#0072B2", "o", "-", ""), Look("#E69F00", "s", "--", "//"), Look("#009E73", "^", "-.", "..")),
        strict=True,
    )
)
FURTHER_LOOKS = (
    Look("#D55E00", "D", ":", "xx"),
    Look("#CC79A7", "v", "-", "\\\\"),
    Look("#56B4E9", "P", "--", "++"),
    Look("#000000", "X", "-.", "oo"),
)


@dataclass(frozen=True)
class Drawing:
    """A figure that can be drawn.

    Attributes:
        name: Name of its files, without the suffix.
        caption: What it shows.
        draw: Draws it.
        panels: Number of panels.
        columns: Panels in a row, at most.
        panel: Width and height of a panel in inches.
    """

    name: str
    caption: str
    draw: Callable[[Sequence[Axes], Figure], None]
    panels: int = 1
    columns: int = 4
    panel: tuple[float, float] = PANEL


def can_draw() -> bool:
    """Return whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def save(drawing: Drawing, folder: Path) -> None:
    """Write a figure as PNG and SVG into a folder.

    Raises:
        OSError: A file cannot be written.
        ImportError: Matplotlib is not installed.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(drawing.columns, drawing.panels)
    rows = ceil(drawing.panels / columns)
    width, height = drawing.panel
    with mpl.rc_context():
        mpl.rcdefaults()  # not the user's own style
        mpl.rcParams.update(_STYLE)
        figure = Figure(figsize=(columns * width, rows * height + 0.4), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = list(figure.subplots(rows, columns, squeeze=False).flat)
        for idle in axes[drawing.panels :]:
            idle.remove()
        drawing.draw(axes[: drawing.panels], figure)
        # It is laid out once: with a layout engine, each file would take a further drawing.
        layout = figure.get_layout_engine()
        assert layout is not None
        layout.execute(figure)
        figure.set_layout_engine(None)
        # Dates and versions would make each file a new one.
        figure.savefig(folder / f"{drawing.name}.png", metadata={"Software": None})
        figure.savefig(folder / f"{drawing.name}.svg", metadata={"Date": None, "Creator": _SALT})


def look_of(system: str) -> Look:
    """Return how a system is drawn; systems that the project does not know look alike."""
    return LOOKS.get(system, FURTHER_LOOKS[0])


def errors(samples: Sequence[Sample], factor: float) -> list[list[float]]:
    """Return the lengths of error bars below and above the medians, 0 where there is no interval."""
    found = [sample.estimate for sample in samples]
    below = [0.0 if isnan(one.low) else (one.median - one.low) / factor for one in found]
    above = [0.0 if isnan(one.high) else (one.high - one.median) / factor for one in found]
    return [below, above]


def add_legend(figure: Figure, axes: Sequence[Axes]) -> None:
    """Put one legend for all panels below them."""
    found = {}
    for one in axes:
        handles, labels = one.get_legend_handles_labels()
        found.update(dict(zip(labels, handles, strict=True)))
    names = sorted(found, key=lambda name: [not name.startswith(label) for label in SYSTEMS.values()])
    if names:
        handles = [found[name] for name in names]
        longest = max(map(len, names)) + _HANDLE
        columns = max(1, int(figure.get_figwidth() * _LETTERS / longest))
        figure.legend(handles, names, loc="outside lower center", ncols=columns, frameon=False, fontsize=8)
