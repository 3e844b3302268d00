"""How well a map agrees with another one of the same floor."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from rce_fleet.maps.distance import distance_field

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rce_fleet.maps.occupancy_map import OccupancyMap

_AROUND = np.ones((3, 3), bool)


@dataclass(frozen=True, slots=True)
class MapAgreement:
    """How well a map agrees with the true one.

    Attributes:
        explored: Share of the true map's free cells that the map knows, 0 .. 1.
        right: Share of the true map's free cells, and of its occupied ones beside them, whose value the map
            has there or in a neighbouring cell, 0 .. 1.
        wall_error_m: Mean distance of the map's occupied cells from the nearest true one, metres.
        wall_error_p95_m: 95 of 100 occupied cells are not farther away than this, metres.
    """

    explored: float
    right: float
    wall_error_m: float
    wall_error_p95_m: float

    def as_json(self) -> dict[str, float]:
        """Return the fields, rounded."""
        return {name: round(value, 4) for name, value in asdict(self).items()}


def compare_maps(made: OccupancyMap, true: OccupancyMap) -> MapAgreement:
    """Compare a map with the true one.

    Args:
        made: The map; may have another origin, rotation and size.
        true: The true one, in the same frame.
    """
    surface = true.occupied & ndimage.binary_dilation(true.free, _AROUND)
    free, occupied = (true.cell_to_world(np.argwhere(mask)) for mask in (true.free, surface))
    explored = ~_at(made, made.unknown, free, outside=True)
    free_near, occupied_near = (ndimage.binary_dilation(mask, _AROUND) for mask in (made.free, made.occupied))
    right = np.concatenate((_at(made, free_near, free), _at(made, occupied_near, occupied)))
    drawn = made.cell_to_world(np.argwhere(made.occupied))
    field = distance_field(true)
    cells = np.clip(true.world_to_cell(drawn), 0, np.array(true.data.shape) - 1)
    nearest = true.cell_to_world(cells)
    errors = field[cells[:, 0], cells[:, 1]]
    # Outside of the true map the distance to its border is added.
    outside = ~true.inside(true.world_to_cell(drawn))
    errors[outside] += np.hypot(*(drawn - nearest)[outside].T)
    known = len(errors) > 0
    return MapAgreement(
        explored=float(explored.mean()) if len(explored) else 1.0,
        right=float(right.mean()) if len(right) else 1.0,
        wall_error_m=float(errors.mean()) if known else 0.0,
        wall_error_p95_m=float(np.percentile(errors, 95)) if known else 0.0,
    )


def _at(
    picture: OccupancyMap, mask: NDArray[np.bool_], points: NDArray[np.float64], *, outside: bool = False
) -> NDArray[np.bool_]:
    """Return the values of a mask of a map at points, shape (N, 2); ``outside`` where the map ends."""
    cells = picture.world_to_cell(points)
    inside = picture.inside(cells)
    cells = np.where(inside[:, None], cells, 0)
    return np.where(inside, mask[cells[:, 0], cells[:, 1]], outside)
