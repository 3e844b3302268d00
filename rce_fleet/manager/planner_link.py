"""The planner's services, as the fleet manager calls them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, assert_never

from rce_fleet.manager.planner_sync import BlockCell, PlannerCall, SetCosts, SetMode, SetZone

if TYPE_CHECKING:
    from rce_fleet.tasks.records import CellBlock, Zone
    from rce_fleet.tasks.zone_costs import OwnCosts


class PlannerLink(Protocol):
    """The planner's services. Each returns why it refused; empty: it did not."""

    async def set_goal(self, robot: str, cell: int | None) -> str:
        """Send a robot to a cell, or remove its goal."""

    async def block_cell(self, cell: int, block: CellBlock | None, now: float) -> str:
        """Block a cell, or free it (None)."""

    async def set_mode(self, robot: str, mode: str, reason: str, user: str) -> str:
        """Set who drives a robot, or the fleet's mode (robot empty)."""

    async def set_zone(self, name: str, zone: Zone | None, now: float) -> str:
        """Make or replace a zone; None: remove it."""

    async def set_costs(self, costs: OwnCosts) -> str:
        """Set what metres in zones count for single robots, in place of all such costs before."""


async def carry_out(planner: PlannerLink, call: PlannerCall, now: float) -> str:
    """Call one of the planner's services; return why it refused.

    Args:
        planner: The services.
        call: What the planner has to be told.
        now: Seconds since 1970.
    """
    match call:
        case SetMode(robot, mode, reason, user):
            return await planner.set_mode(robot, mode, reason, user)
        case SetZone(name, zone):
            return await planner.set_zone(name, zone, now)
        case SetCosts(costs):
            return await planner.set_costs(costs)
        case BlockCell(cell, blocked, block):
            return await planner.block_cell(cell, block if blocked else None, now)
        case _:
            assert_never(call)
