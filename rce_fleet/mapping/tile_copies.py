"""Tiles for writing: made or copied when a map first writes to them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.compiled import helper

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@helper
def own_tile(
    table: NDArray[np.int32],
    counts: NDArray[np.int32],
    points: NDArray[np.float32],
    owner: NDArray[np.uint8],
    references: NDArray[np.int32],
    free: NDArray[np.int32],
    state: NDArray[np.int64],
    row: int,
    column: int,
) -> int:
    """Return the number of a tile that only this table uses, made or copied if need be."""
    tile = table[row, column]
    if tile >= 0 and references[tile] == 1:
        return int(tile)
    state[0] -= 1
    made = free[state[0]]
    if tile < 0:
        counts[made] = 0
        points[made] = 0.0
        owner[made] = 0
    else:
        counts[made] = counts[tile]
        points[made] = points[tile]
        owner[made] = owner[tile]
        references[tile] -= 1
    references[made] = 1
    table[row, column] = made
    return int(made)
