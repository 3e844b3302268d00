"""The grids that can be laid over the planner's map, for its service ``/fleet/set_grid``."""

from __future__ import annotations

import asyncio
import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from rce_fleet.coordination.grid_change import carried_cells
from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.fleet_grid import BLOCKED_SHARE, fleet_grid, map_of_grid
from rce_fleet.maps.ros_map import load_map
from rce_fleet.nodes.grid_parameters import read_cells, read_number

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rce.ros.types import Message
    from rce_fleet.maps.occupancy_map import OccupancyMap
    from rce_fleet.planning.grid import GridMap

MAX_CELLS = 100_000
"""Cells of a grid that is chosen while the planner runs."""
CHOSEN = "chosen_grid"
"""Private parameter of the planner with the grid that was chosen, for a planner that is started again."""


@dataclass(frozen=True, slots=True)
class GridChoice:
    """Where the cells lie, and what blocks one.

    Attributes:
        cell_size: Edge of a cell, metres.
        origin_x, origin_y: Outer corner of cell 0, metres.
        origin_yaw: Direction of the columns, radians.
        blocked_share: A cell is blocked if more than this share of it is occupied, unknown or cut off.
    """

    cell_size: float
    origin_x: float
    origin_y: float
    origin_yaw: float
    blocked_share: float


class GridChooser:
    """Makes grids over the planner's map.

    The map is the ROS map of the parameters. Without one it is the first grid: its walls are occupied.

    Args:
        values: The planner's parameters.
        grid: The grid that they describe.

    Raises:
        MapError: The map file cannot be read.
        OSError: The map file cannot be opened.
    """

    def __init__(self, values: Mapping[str, Any], grid: GridMap) -> None:
        self._first = grid
        self._values = {name: value for name, value in values.items() if name != CHOSEN}
        self._walls = read_cells(values, "walls") if values.get("map_yaml") else []
        self._drawn: OccupancyMap = (
            load_map(str(values["map_yaml"])) if values.get("map_yaml") else map_of_grid(grid)
        )
        self.blocked_share = read_number(values, "blocked_share", BLOCKED_SHARE)

    def read(self, request: Message) -> GridChoice:
        """Return the choice of a ``fleet/SetGrid`` request."""
        share = request.blocked_share
        place = request.origin_x, request.origin_y, request.origin_yaw
        return GridChoice(request.cell_size, *place, self.blocked_share if share == -1 else share)

    async def make(self, choice: GridChoice) -> GridMap:
        """Return the grid of a choice.

        Raises:
            MapError: There is no such grid; the text says why.
        """
        return await asyncio.to_thread(self._make, choice)

    def _make(self, choice: GridChoice) -> GridMap:
        origin = Pose(choice.origin_x, choice.origin_y, choice.origin_yaw)
        grid = fleet_grid(
            self._drawn,
            choice.cell_size,
            origin=origin,
            blocked_share=choice.blocked_share,
            max_cells=MAX_CELLS,
        )
        return grid.with_blocked(grid.blocked | carried_cells(self._first, grid, self._walls))

    async def answer(
        self, choice: GridChoice, refuse: Callable[[GridMap], str], *, preview: bool
    ) -> tuple[dict[str, Any], GridMap | None]:
        """Return the fields of a ``fleet/SetGrid`` response, and the grid to take over; None if none.

        Args:
            choice: The grid that is asked for.
            refuse: Returns why a grid cannot be taken over now; empty if it can.
            preview: Whether it is only asked for.
        """
        try:
            grid = await self.make(choice)
        except MapError as error:
            return {"ok": False, "message": str(error)}, None
        reply = {
            "rows": grid.rows,
            "columns": grid.columns,
            "walls": sorted(grid.blocked),
            "blocked_share": choice.blocked_share,
        }
        reason = refuse(grid)
        if preview:
            text = f"it cannot be taken over now: {reason}" if reason else "it can be taken over"
            return {"ok": True, "message": text, **reply}, None
        if reason:
            return {"ok": False, "message": reason, **reply}, None
        text = f"the fleet has a grid of {grid.columns} x {grid.rows} cells of {grid.cell_size:g} m"
        return {"ok": True, "message": f"{text}; goals are removed", **reply}, grid

    def blocked_at_start(self, grid: GridMap) -> list[int]:
        """Return the cells of a grid that the parameters block, and that can be freed."""
        blocked = read_cells(self._values, "blocked")
        return blocked if grid is self._first else sorted(carried_cells(self._first, grid, blocked))

    def stored(self, choice: GridChoice) -> str:
        """Return a text to store a choice, with the parameters that it was made over."""
        return json.dumps({"choice": asdict(choice), "over": self._values}, sort_keys=True)

    def restored(self, text: str) -> GridChoice | None:
        """Return a stored choice; None if it was made over other parameters, or cannot be read."""
        try:
            found = json.loads(text)
            if found["over"] != json.loads(json.dumps(self._values)):
                return None
            return GridChoice(**found["choice"])
        except (ValueError, TypeError, KeyError):
            return None

    async def grid_at_start(self, stored: object) -> tuple[GridMap, str]:
        """Return the grid to begin with, and a remark for the log.

        Args:
            stored: The parameter with a choice, if there is one.
        """
        choice = self.restored(stored) if isinstance(stored, str) else None
        if choice is None:
            return self._first, ""
        try:
            grid = await self.make(choice)
        except MapError as error:
            return self._first, f"the grid that was chosen cannot be used again: {error}"
        self.blocked_share = choice.blocked_share
        return grid, f"the grid that was chosen is used again: cells of {choice.cell_size:g} m"
