"""The three set-ups of the paper as data, and drawings made from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

from rce_fleet.experiments.report.drawing import INK, Drawing, look_of
from rce_fleet.experiments.report.labels import SYSTEMS, system_label

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROBOTS = "TurtleBots 1 to 5"
_WIDTH, _GAP, _ROW, _PROGRAM = 4.2, 2.6, 1.15, 0.75
"""Sizes of machines, the space between them, a row and a program, in units of the drawing."""
_HEAD = 0.7
_NAMES = {
    "single_master": "Single Master System",
    "multi_master": "Multi Master System",
    "cloud": "Cloud Robotics System",
}


class Program(NamedTuple):
    """A program, or several alike, on a machine.

    Attributes:
        name: What it is.
        machine: 1 or 2.
        row: Where it stands on its machine, from the top.
        inside: Number of rows that its container has, from this one; 0 for a program.
    """

    name: str
    machine: int
    row: int
    inside: int = 0


class Flow(NamedTuple):
    """What passes between two programs.

    Attributes:
        source: Name of a program.
        target: Name of another one.
        text: What passes, and how.
        is_data: Whether messages of topics pass; otherwise it only sets things up.
    """

    source: str
    target: str
    text: str
    is_data: bool = False


@dataclass(frozen=True)
class SetUp:
    """A system with its programs on two machines."""

    programs: tuple[Program, ...]
    flows: tuple[Flow, ...]

    @property
    def rows(self) -> int:
        """Number of rows of its machines."""
        return 1 + max(program.row + max(program.inside - 1, 0) for program in self.programs)


SET_UPS = {
    "single_master": SetUp(
        (
            Program("ROS master", 1, 0),
            Program("subscriber, prints", 1, 1),
            Program(ROBOTS, 2, 1),
        ),
        (
            Flow(ROBOTS, "ROS master", "register"),
            Flow(ROBOTS, "subscriber, prints", "scans", is_data=True),
        ),
    ),
    "multi_master": SetUp(
        (
            Program("ROS master 1", 1, 0),
            Program("sync 1", 1, 1),
            Program("discovery 1", 1, 2),
            Program("subscriber, prints", 1, 3),
            Program("ROS master 2", 2, 0),
            Program("sync 2", 2, 1),
            Program("discovery 2", 2, 2),
            Program(ROBOTS, 2, 3),
        ),
        (
            Flow("discovery 2", "discovery 1", "heartbeats"),
            Flow("discovery 2", "sync 1", "graph of machine 2"),
            Flow("sync 1", "ROS master 1", "register"),
            Flow(ROBOTS, "subscriber, prints", "scans", is_data=True),
        ),
    ),
    "cloud": SetUp(
        (
            Program("rce-master", 1, 0),
            Program("rce-robot", 1, 1),
            Program("container", 1, 2, 2),
            Program("ROS master C", 1, 2),
            Program("node, prints", 1, 3),
            Program("rce-ros 1 to 5", 2, 1),
            Program(ROBOTS, 2, 2),
            Program("ROS masters of the robots", 2, 3),
        ),
        (
            Flow("rce-ros 1 to 5", "rce-master", "HTTP 9000"),
            Flow(ROBOTS, "rce-ros 1 to 5", "scans", is_data=True),
            Flow("rce-ros 1 to 5", "rce-robot", "WebSocket 9010", is_data=True),
            Flow("rce-robot", "node, prints", "link", is_data=True),
        ),
    ),
}


def schematics() -> list[Drawing]:
    """Return a drawing of each set-up."""
    return [
        Drawing(
            f"set-up-{system.replace('_', '-')}",
            f"{_NAMES[system]} ({system_label(system)}): machine 1 is `server`, machine 2 is `client`",
            partial(_draw, system),
            panel=(6.4, 0.9 + 0.62 * SET_UPS[system].rows),
        )
        for system in SYSTEMS
    ]


def _draw(system: str, axes: Sequence[Axes], figure: Figure) -> None:
    del figure
    (plane,) = axes
    set_up = SET_UPS[system]
    height = set_up.rows * _ROW + _HEAD
    for machine in (1, 2):
        left = _left(machine)
        _add_box(plane, (left, -height), _WIDTH, height, "#F2F2F2")
        name = "machine 1 (server)" if machine == 1 else "machine 2 (client)"
        plane.text(left + _WIDTH / 2, -_HEAD / 2, name, ha="center", va="center", weight="bold")
    for program in sorted(set_up.programs, key=lambda program: -program.inside):
        _add_program(plane, program, look_of(system).colour)
    places = {program.name: program for program in set_up.programs}
    for flow in set_up.flows:
        _add_flow(plane, places[flow.source], places[flow.target], flow, look_of(system).colour)
    plane.set(xlim=(-0.2, 2 * _WIDTH + _GAP + 0.2), ylim=(-height - 0.2, 0.2), aspect="equal")
    plane.set_axis_off()
    plane.set_title(f"{_NAMES[system]} ({system_label(system)})")


def _left(machine: int) -> float:
    return 0.0 if machine == 1 else _WIDTH + _GAP


def _middle(program: Program) -> float:
    return -_HEAD - (program.row + 0.5) * _ROW


def _add_box(plane: Axes, corner: tuple[float, float], width: float, height: float, colour: str) -> None:
    from matplotlib.patches import FancyBboxPatch

    box = FancyBboxPatch(
        corner,
        width,
        height,
        boxstyle="round,pad=0,rounding_size=0.12",
        facecolor=colour,
        edgecolor=INK,
        linewidth=0.8,
    )
    plane.add_patch(box)


def _add_program(plane: Axes, program: Program, colour: str) -> None:
    left, middle = _left(program.machine), _middle(program)
    if program.inside:
        top, bottom = middle + _ROW / 2, middle - (program.inside - 0.5) * _ROW
        _add_box(plane, (left + 0.15, bottom + 0.06), _WIDTH - 0.3, top - bottom - 0.1, "#DDDDDD")
        plane.text(
            left + 0.28, (top + bottom) / 2, program.name, rotation=90, va="center", ha="center", fontsize=7
        )
        return
    _add_box(plane, (left + 0.45, middle - _PROGRAM / 2), _WIDTH - 0.9, _PROGRAM, "white")
    plane.text(left + _WIDTH / 2, middle, program.name, ha="center", va="center", color=INK)
    plane.plot([left + 0.53] * 2, [middle - 0.25, middle + 0.25], color=colour, linewidth=3)


def _add_flow(plane: Axes, source: Program, target: Program, flow: Flow, colour: str) -> None:
    """Draw an arrow along its corners, with its text at the middle of the longest part."""
    corners = _corners(source, target)
    shown: dict[str, Any] = {
        "color": colour if flow.is_data else INK,
        "linestyle": "-" if flow.is_data else "--",
        "linewidth": 1.8 if flow.is_data else 1.0,
    }
    plane.plot(*zip(*corners[:-1], strict=True), **shown)
    head = {"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, **shown}
    plane.annotate("", xy=corners[-1], xytext=corners[-2], arrowprops=head)
    begin, end = max(pairwise(corners), key=_length)
    is_upright = begin[0] == end[0]
    is_short = len(corners) == 2 and is_upright  # noqa: PLR2004 - its two ends
    plane.text(
        (begin[0] + end[0]) / 2 + (0.15 if is_short else 0.0),
        (begin[1] + end[1]) / 2,
        flow.text,
        ha="left" if is_short else "center",
        va="center",
        rotation=90 if is_upright and not is_short else 0,
        fontsize=7.5,
        bbox=None if is_short else {"facecolor": "white", "edgecolor": "none", "pad": 0.8},
    )


def _length(ends: tuple[tuple[float, float], tuple[float, float]]) -> float:
    (x, y), (other_x, other_y) = ends
    return abs(x - other_x) + abs(y - other_y)


def _corners(source: Program, target: Program) -> list[tuple[float, float]]:
    """Return the corners of a flow: straight to a neighbour, otherwise past the programs between."""
    begin, end = _middle(source), _middle(target)
    right = _left(source.machine) + _WIDTH - 0.45
    if source.machine != target.machine:
        return [(_left(2) + 0.45, begin), (_left(1) + _WIDTH - 0.45, end)]
    if abs(source.row - target.row) == 1:
        side = _PROGRAM / 2 if end > begin else -_PROGRAM / 2
        middle = _left(source.machine) + _WIDTH / 2
        return [(middle, begin + side), (middle, end - side)]
    return [(right, begin - 0.15), (right + 0.3, begin - 0.15), (right + 0.3, end), (right, end)]
