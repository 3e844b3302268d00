"""Requests of the fleet's API about the floor: the map, blocked cells, zones and chargers."""

from __future__ import annotations

from rce_fleet.api.fleet import (
    ChargersModel,
    ChargersState,
    FleetMapModel,
    ZoneList,
    ZoneModel,
    ZoneRequest,
)
from rce_fleet.client.requests import ApiRequests, if_match, path_part
from rce_fleet.station.api import Answer, CellRequest, FleetModel


class FloorRequests(ApiRequests):
    """Reads and changes what robots may drive on."""

    async def fleet(self) -> FleetModel:
        """Return the planner's view: robots with poses and paths, and blocked cells.

        Example:
            ```python
            print((await fleet.fleet()).blocked)
            ```
        """
        return await self._read("/fleet", FleetModel)

    async def set_blocked(
        self, cell: int, *, blocked: bool, reason: str = "", until: float | None = None
    ) -> str:
        """Block or free a cell; return the answer for people.

        Args:
            cell: The cell.
            blocked: Whether to block it.
            reason: Why it is blocked, for people.
            until: When a blocked cell is freed, seconds since 1970; None: it stays blocked.

        Example:
            ```python
            print(await fleet.set_blocked(17, blocked=True, reason="spill", until=1796000000.0))
            print([(block.cell, block.user, block.robot) for block in (await fleet.map()).blocks])
            ```
        """
        given: dict[str, object] = {"blocked": blocked}
        if reason:
            given["reason"] = reason
        if until is not None:
            given["until"] = until
        request = CellRequest.model_validate(given)
        return (await self._send("PUT", f"/cells/{cell}", Answer, request)).message

    async def map(self) -> FleetMapModel:
        """Return the grid.

        Example:
            ```python
            grid = await fleet.map()
            ```
        """
        return await self._read("/map", FleetMapModel)

    async def zones(self) -> list[ZoneModel]:
        """Return all zones.

        Example:
            ```python
            print([zone.id for zone in await fleet.zones()])
            ```
        """
        zones: list[ZoneModel] = []
        query = {"limit": "100"}
        while True:
            page = await self._read("/zones", ZoneList, query)
            zones += page.zones
            if page.next is None:
                return zones
            query["cursor"] = page.next

    async def zone(self, name: str) -> ZoneModel:
        """Return a zone.

        Example:
            ```python
            print((await fleet.zone("gate")).revision)
            ```
        """
        return await self._read(f"/zones/{path_part(name)}", ZoneModel)

    async def set_zone(self, name: str, zone: ZoneRequest, *, revision: int | None = None) -> ZoneModel:
        """Make or replace a zone.

        Example:
            ```python
            await fleet.set_zone("gate", ZoneRequest(kind="slow", cells=[4, 5], value=0.2))
            ```
        """
        return await self._change("PUT", f"/zones/{path_part(name)}", ZoneModel, zone, revision)

    async def remove_zone(self, name: str, *, revision: int | None = None) -> None:
        """Remove a zone.

        Example:
            ```python
            await fleet.remove_zone("gate")
            ```
        """
        await self._transport.request(
            *("DELETE", f"/zones/{path_part(name)}"),
            headers=if_match(revision),
            repeatable=revision is None,
            removes=True,
        )

    async def chargers(self) -> ChargersState:
        """Return chargers, parking places and return cells, and who charges.

        Example:
            ```python
            print((await fleet.chargers()).waiting)
            ```
        """
        return await self._read("/chargers", ChargersState)

    async def set_chargers(self, places: ChargersModel, *, revision: int | None = None) -> ChargersState:
        """Replace chargers, parking places and return cells.

        Example:
            ```python
            await fleet.set_chargers(ChargersModel(chargers=[0, 7]))
            ```
        """
        return await self._change("PUT", "/chargers", ChargersState, places, revision)
