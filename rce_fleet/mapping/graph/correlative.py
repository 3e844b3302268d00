"""Correlative scan matching: the pose in a window at which a scan fits a field best.

After Olson 2009, "Real-time correlative scan matching"; the exact search in a pyramid after Hess et al. 2016,
"Real-time loop closure in 2D LIDAR SLAM", section V.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.mapping.graph.fields import PEAK, FieldPyramid
from rce_fleet.mapping.graph.search import SCALE, search

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Window:
    """Where a pose is searched, around the expected one.

    Attributes:
        reach: Greatest shift along x and along y, metres.
        turn: Greatest turn to each side, radians.
        turn_step: Angle between two tried turns, radians.
        prior_weight: What a pose at the border of the window loses along each axis, as share of a perfect
            score.
    """

    reach: float
    turn: float
    turn_step: float
    prior_weight: float = 0.0


@dataclass(frozen=True, slots=True)
class Match:
    """A pose found by the search.

    Attributes:
        pose: (x, y, yaw) of the scan in the field's frame, shape (3,).
        score: Mean value of the field at the scan's points, from 0 to 1, less what the prior takes.
    """

    pose: NDArray[np.float64]
    score: float


def find_match(
    field: FieldPyramid,
    points: NDArray[np.float64],
    expected: NDArray[np.float64],
    window: Window,
    *,
    other_than: NDArray[np.float64] | None = None,
    apart: tuple[float, float] = (0.0, 0.0),
    at_least: float = 0.0,
) -> Match | None:
    """Return the best pose of a scan in a window, or None if all score less than ``at_least``.

    Args:
        field: Field to match against.
        points: The scan, shape (N, 2), metres.
        expected: Centre (x, y, yaw) of the window, shape (3,).
        window: Size of the window.
        other_than: A pose to keep away from, to find the second best peak.
        apart: Poses nearer to it than this (metres along both axes, and radians) are left out.
        at_least: Least score.
    """
    if len(points) == 0:
        return None
    turns = max(0, round(window.turn / window.turn_step))
    steps = np.arange(-turns, turns + 1)
    yaws = expected[2] + steps * window.turn_step
    reach = max(1, int(np.ceil(window.reach / field.cell)))
    cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    placed = np.stack(
        (
            expected[0] + cos * points[:, 0] - sin * points[:, 1],
            expected[1] + sin * points[:, 0] + cos * points[:, 1],
        ),
        axis=-1,
    )
    cells = field.cells(placed)
    full = PEAK * len(points)
    weight = round(window.prior_weight * full * SCALE)
    turn_costs = (weight * steps.astype(np.int64) ** 2) // max(1, turns) ** 2 // SCALE
    excluded = np.full(5, -1, np.int64)
    if other_than is not None:
        shift = np.round((other_than[:2] - expected[:2]) / field.cell).astype(np.int64)
        turn = np.angle(np.exp(1j * (other_than[2] - expected[2])))
        excluded[:] = (
            round(turn / window.turn_step) + turns,
            shift[1],
            shift[0],
            round(apart[1] / window.turn_step),
            round(apart[0] / field.cell),
        )
    floor = int(np.ceil(at_least * full))
    found = search(
        field.levels,
        np.ascontiguousarray(cells[:, :, 0]),
        np.ascontiguousarray(cells[:, :, 1]),
        reach,
        turn_costs,
        weight,
        excluded,
        floor,
    )
    score, turn_index, row, column = (int(value) for value in found)
    if score < floor or turn_index < 0:
        return None
    pose = np.array(
        (expected[0] + column * field.cell, expected[1] + row * field.cell, yaws[turn_index]), np.float64
    )
    return Match(pose, score / full)
