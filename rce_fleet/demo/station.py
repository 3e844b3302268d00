"""The operator station's HTTP API, as an ERP would use it."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

import aiohttp
from pydantic import ValidationError
from yarl import URL

from rce_fleet.demo.exceptions import StationAwayError, WishRefusedError
from rce_fleet.station.api import FleetModel

TIMEOUT = aiohttp.ClientTimeout(total=15)


class StationApi:
    """Reads the fleet's state and sends requests.

    Args:
        session: What HTTP goes through.
        url: The station's page.
    """

    def __init__(self, session: aiohttp.ClientSession, url: str) -> None:
        self._session = session
        self._api = URL(url) / "api/v1"

    async def fleet(self) -> FleetModel:
        """Return the state of the whole fleet.

        Raises:
            StationError: It cannot be had.
        """
        answer = await self._ask("GET", "fleet")
        try:
            return FleetModel.model_validate(answer)
        except ValidationError as error:
            raise WishRefusedError(f"the station's answer cannot be read: {error}") from error

    async def set_goal(self, robot: str, cell: int | None) -> None:
        """Send a robot to a cell.

        Raises:
            StationError: That was not done.
        """
        await self._ask("PUT", f"robots/{robot}/goal", {"cell": cell})

    async def block(self, cell: int, *, blocked: bool) -> None:
        """Block or free a cell.

        Raises:
            StationError: That was not done.
        """
        await self._ask("PUT", f"cells/{cell}", {"blocked": blocked})

    async def _ask(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        try:
            async with self._session.request(method, self._api / path, json=body, timeout=TIMEOUT) as reply:
                answer = await reply.json(content_type=None)
                if reply.ok:
                    return answer
                problem = answer.get("error", reply.reason) if isinstance(answer, dict) else reply.reason
                if reply.status >= HTTPStatus.INTERNAL_SERVER_ERROR:
                    raise StationAwayError(str(problem))
                raise WishRefusedError(str(problem))
        except (aiohttp.ClientError, TimeoutError, ValueError) as error:
            raise StationAwayError(f"the station cannot be reached: {error}") from error
