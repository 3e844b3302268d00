"""A client of the operator station's HTTP API."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

import aiohttp
from pydantic import ValidationError
from yarl import URL

from rce_fleet.exceptions import RequestRefusedError, StationUnavailableError
from rce_fleet.station.api import FleetModel, GridAnswer, GridRequest

TIMEOUT = aiohttp.ClientTimeout(total=15)


class StationClient:
    """Reads the fleet's state, sets goals and blocks cells.

    Args:
        session: Sends the HTTP requests.
        url: URL of the station's page.
    """

    def __init__(self, session: aiohttp.ClientSession, url: str) -> None:
        self._session = session
        self._api = URL(url) / "api/v1"

    async def fleet(self) -> FleetModel:
        """Return the state of the whole fleet.

        Raises:
            StationUnavailableError: The station cannot be reached.
            RequestRefusedError: The answer is not a fleet's state.
        """
        answer = await self._request("GET", "fleet")
        try:
            return FleetModel.model_validate(answer)
        except ValidationError as error:
            raise RequestRefusedError(f"the station's answer is not a fleet's state: {error}") from error

    async def has_open_tasks(self) -> bool:
        """Return whether a task is open at the fleet manager.

        Raises:
            StationUnavailableError: Station or fleet manager cannot be reached.
            RequestRefusedError: The request was refused.
        """
        answer = await self._request("GET", "tasks", query={"state": "open", "limit": "1"})
        return bool(answer["tasks"])

    async def set_goal(self, robot: str, cell: int | None) -> None:
        """Send a robot to a cell, or stop it (None).

        Raises:
            StationUnavailableError: Station or planner cannot be reached.
            RequestRefusedError: The request was refused.
        """
        await self._request("PUT", f"robots/{robot}/goal", {"cell": cell})

    async def set_blocked(self, cell: int, *, blocked: bool) -> None:
        """Block or free a cell.

        Raises:
            StationUnavailableError: Station or planner cannot be reached.
            RequestRefusedError: The request was refused.
        """
        await self._request("PUT", f"cells/{cell}", {"blocked": blocked})

    async def set_grid(self, grid: GridRequest, *, preview: bool = False) -> GridAnswer:
        """Change the grid of cells, or only return the grid that it would be.

        Raises:
            StationUnavailableError: Station or planner cannot be reached.
            RequestRefusedError: The request was refused, for example because a robot drives.
        """
        method, path = ("POST", "grid/preview") if preview else ("PUT", "grid")
        return GridAnswer.model_validate(await self._request(method, path, grid.model_dump()))

    async def _request(
        self,
        method: str,
        path: str,
        body: dict[str, Any] | None = None,
        query: dict[str, str] | None = None,
    ) -> Any:
        url = (self._api / path).with_query(query)
        try:
            async with self._session.request(method, url, json=body, timeout=TIMEOUT) as reply:
                answer = await reply.json(content_type=None)
                if reply.ok:
                    return answer
                problem = answer.get("error", reply.reason) if isinstance(answer, dict) else reply.reason
                if reply.status >= HTTPStatus.INTERNAL_SERVER_ERROR:
                    raise StationUnavailableError(str(problem))
                raise RequestRefusedError(str(problem))
        except (aiohttp.ClientError, TimeoutError, ValueError) as error:
            raise StationUnavailableError(f"the station cannot be reached: {error}") from error
