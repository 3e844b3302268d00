"""Whether a robot can pass a cell of the fleet's grid."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LEAST_SIDES = 2
_ALL_NEIGHBOURS = np.ones((3, 3), np.int64)


def can_pass(blocked: NDArray[np.bool_], cell_size: float, radius: float, tolerance: float = 0.1) -> bool:
    """Return whether a robot can use a cell: stand in its middle, and get there from two sides at least.

    The fleet's robots drive from middle to middle. A robot holds its cell, not those beside it: so its centre
    may cross the cell's sides only between the corners, and must else be a radius away from them.

    Args:
        blocked: Parts of the cell that are not free, shape (N, N).
        cell_size: Edge of the cell, metres.
        radius: Radius of the robot, metres.
        tolerance: How far from the middle it may stand, metres.
    """
    count = len(blocked)
    part = cell_size / count
    if not blocked.any():
        return cell_size >= 2 * radius
    # Between centres of parts; a part reaches half of its edge nearer.
    away = ndimage.distance_transform_edt(~blocked) * part - part / 2
    border = min(int(np.ceil(radius / part - 1e-9)), (count - 1) // 2)
    between = np.zeros(count, np.bool_)
    between[border : count - border] = True
    possible = (away >= radius) & (between[:, None] | between[None, :])
    labels, _ = ndimage.label(possible, structure=_ALL_NEIGHBOURS)
    off = (np.arange(count) + 0.5) * part - cell_size / 2
    middle = labels[np.hypot(off[:, None], off[None, :]) <= max(tolerance, part)]
    sides = [set(line[line > 0].tolist()) for line in (labels[0], labels[-1], labels[:, 0], labels[:, -1])]
    return any(
        sum(label in side for side in sides) >= _LEAST_SIDES for label in set(middle[middle > 0].tolist())
    )
