"""The demo's own floor: 8 x 8 cells, with walls that look different from every direction.

Localization without a first pose needs a floor that has no symmetry, neither by rotation nor in a mirror.
``configs/scene.yaml`` is the same floor, and ``configs/map.yaml`` its map.

::

    row 7   .  .  .  .  .  .  .  .
    row 6   .  .  #  .  .  .  .  .
    row 5  >.  #  #  .  .  #  .  .       >: alcove in the outer wall
    row 4   .  .  .  .  .  #  .  .
    row 3   .  .  .  .  .  .  .  .<      <: niche in the outer wall
    row 2   .  .  .  .  #  #  D  #       D: a door, open unless it is told to close
    row 1   .  #  .  .  .  .  .  .
    row 0   .  .  .  .  .  .  .  .
"""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING

from rce_fleet.drivers.scene_items import DoorItem, WallItem
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from rce_fleet.drivers.scene import Scene

FLOOR = GridMap(rows=8, columns=8, cell_size=1.0, blocked=frozenset({9, 20, 21, 23, 37, 41, 42, 45, 50}))
"""The cells."""

OUTER_WALL = WallItem(
    line=(
        *((0.0, 0.0), (8.0, 0.0)),
        *((8.0, 3.1), (8.3, 3.1), (8.3, 3.7), (8.0, 3.7), (8.0, 8.0)),
        *((0.0, 8.0), (0.0, 6.0), (-0.7, 6.0), (-0.7, 5.0), (0.0, 5.0)),
    ),
    closed=True,
)
"""The wall around the floor, with an alcove in the west and a niche in the east."""

DOOR = DoorItem(id="door", at=(6.0, 2.0), yaw=0.0, width=0.95, swing=pi / 2, open=True)
"""The door between the room in the south-east and the hall."""


def with_surroundings(scene: Scene) -> Scene:
    """Return a scene of the floor's cells with what its cells do not show: the outer wall and the door."""
    more = {"enclosed": False, "walls": (*scene.walls, OUTER_WALL), "doors": (*scene.doors, DOOR)}
    return scene.model_copy(update=more)
