"""Requests for another grid of cells: between the station's HTTP API and the planner's service."""

from __future__ import annotations

from typing import Any

from rce_fleet.station.api import GridAnswer, GridRequest
from rce_fleet.station.planner_client import PlannerUnavailableError

AS_NOW = -1.0
"""The share of a ``fleet/SetGrid`` request that stands for the current one."""


def complete_grid(asked: GridRequest, current: dict[str, Any] | None) -> dict[str, Any]:
    """Return the fields of a ``fleet/SetGrid`` request.

    Args:
        asked: What is asked for; the rest stays as it is.
        current: The grid, in the form of page and API.

    Raises:
        PlannerUnavailableError: The current grid is not known yet.
    """
    if current is None:
        raise PlannerUnavailableError("the fleet's grid is not known yet: the planner has sent no state")
    x, y = current["origin"] if asked.origin is None else asked.origin
    return {
        "cell_size": current["cell_size"] if asked.cell_size is None else asked.cell_size,
        "origin_x": x,
        "origin_y": y,
        "origin_yaw": current["yaw"] if asked.yaw is None else asked.yaw,
        "blocked_share": AS_NOW if asked.blocked_share is None else asked.blocked_share,
    }


def grid_answer(choice: dict[str, Any], answer: dict[str, Any]) -> GridAnswer:
    """Return the answer of the API for a request and a ``fleet/SetGrid`` response, in its JSON form."""
    return GridAnswer(
        message=answer["message"],
        rows=answer["rows"],
        columns=answer["columns"],
        cell_size=choice["cell_size"],
        origin=[choice["origin_x"], choice["origin_y"]],
        yaw=choice["origin_yaw"],
        blocked_share=answer["blocked_share"],
        walls=answer["walls"],
    )
