"""What zones allow while paths are entered into the ledger. Pure.

Zones can change while a plan is made. The rules are read once for many moves: to ask the book of zones for
each robot would take long with large zones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.coordination.zones import ZoneKind

if TYPE_CHECKING:
    from rce_fleet.coordination.fleet_state import FleetState


class ZoneRules:
    """The rules of the zones as they are now.

    Args:
        state: The fleet; its zones do not change while this object is used.
    """

    def __init__(self, state: FleetState) -> None:
        zones = state.zones
        self._zones = zones
        self._grid = state.grid
        self._closed = zones.closed(state.grid)
        self._own: dict[str, tuple[frozenset[int], frozenset[tuple[int, int]]]] = {}
        self._limited = [
            (zone, zones.cells(zone), set(filter(zone.applies_to, state.zone_users(zone))))
            for zone in zones.of_kind(ZoneKind.LIMITED)
        ]

    def admit(self, robot: str, before: int, cell: int) -> bool:
        """Return whether a robot may drive from a cell to the next; count it in the zones that it enters."""
        if (before, cell) in self._closed:
            return False
        own = self._own.get(robot)
        if own is None:
            own = self._own[robot] = self._zones.forbidden(robot), self._zones.closed_for(robot, self._grid)
        forbidden, closed = own
        if (cell in forbidden and before not in forbidden) or (before, cell) in closed:
            return False
        entered = []
        for zone, cells, users in self._limited:
            if cell in cells and robot not in users and zone.applies_to(robot):
                if len(users) >= zone.capacity:
                    return False
                entered.append(users)
        for users in entered:
            users.add(robot)
        return True
