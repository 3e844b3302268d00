"""The values of a costmap, and how they are computed and published.

Constants and cost function are those of ROS's costmap_2d (wiki page costmap_2d, sections "Inflation" and
"Map Types"; the function is ``InflationLayer::computeCost``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

FREE = 0
"""Nothing is known to be near."""
INSCRIBED = 253
"""A robot whose centre is here touches an obstacle, whatever its heading."""
LETHAL = 254
"""An obstacle is here."""
UNKNOWN = 255
"""No sensor and no map has told of this cell."""

OCCUPANCY_UNKNOWN = -1
_OCCUPANCY_LETHAL, _OCCUPANCY_INSCRIBED = 100, 99


def cost_of_distance(
    distance: ArrayLike, inscribed_radius: float, cost_scaling_factor: float
) -> NDArray[np.uint8]:
    """Return the cost of cells by their distance to the nearest obstacle.

    Args:
        distance: Metres between the centres of both cells, any shape.
        inscribed_radius: Radius of the largest circle inside the footprint, metres.
        cost_scaling_factor: How quickly costs fall, per metre.

    Returns:
        254 at distance 0, 253 up to the inscribed radius, and beyond it
        ``252 exp(-cost_scaling_factor (distance - inscribed_radius))``, rounded down.
    """
    away = np.asarray(distance, np.float64)
    falling = (INSCRIBED - 1) * np.exp(-cost_scaling_factor * np.maximum(away - inscribed_radius, 0.0))
    costs = np.where(away <= inscribed_radius, INSCRIBED, falling.astype(np.uint8))
    return np.where(away == 0.0, LETHAL, costs).astype(np.uint8)


def _table_of_occupancy() -> NDArray[np.int8]:
    """Return the published value of each cost, shape (256,); as in ``Costmap2DPublisher``."""
    costs = np.arange(256)
    table = (1 + 97 * (costs - 1) // 251).astype(np.int8)
    table[FREE], table[UNKNOWN] = 0, OCCUPANCY_UNKNOWN
    table[INSCRIBED], table[LETHAL] = _OCCUPANCY_INSCRIBED, _OCCUPANCY_LETHAL
    return table


_TO_OCCUPANCY = _table_of_occupancy()


def to_occupancy(costs: NDArray[np.uint8]) -> NDArray[np.int8]:
    """Return the values of ``nav_msgs/OccupancyGrid`` for costs: -1, 0, 1 .. 98, 99 (inscribed), 100."""
    return _TO_OCCUPANCY[costs]


def from_occupancy(
    values: NDArray[np.int8],
    *,
    lethal_threshold: int = 100,
    unknown_value: int = -1,
    track_unknown: bool = True,
    trinary: bool = True,
) -> NDArray[np.uint8]:
    """Return the costs of a map's values, as costmap_2d's static layer interprets them.

    Args:
        values: Values of ``nav_msgs/OccupancyGrid``, any shape: -1, 0 .. 100.
        lethal_threshold: Values from this on are obstacles.
        unknown_value: The value that means unknown.
        track_unknown: Unknown cells stay unknown; else they are free.
        trinary: Values below the threshold are free; else their costs are in proportion.
    """
    signed = np.arange(256, dtype=np.uint8).view(np.int8).astype(np.int16)
    lethal = signed >= lethal_threshold
    below = np.clip(signed, 0, None) / max(lethal_threshold, 1) * LETHAL
    table = np.where(lethal, LETHAL, 0.0 if trinary else below)
    table[signed == unknown_value] = UNKNOWN if track_unknown else FREE
    # Looked up: a floor of 500 m has a hundred million cells.
    return np.asarray(table.astype(np.uint8)[values.astype(np.int8, copy=False).view(np.uint8)])
