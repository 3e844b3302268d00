"""The REST API, loaded with the first request for it.

Its models take 10 MB, and robots do not need them.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aiohttp import web

    from rce_master.http.api import Api
    from rce_master.http.routes import Services


class LateApi:
    """Answers all requests for paths of the API.

    Args:
        services: What the handlers work with.
    """

    def __init__(self, services: Services) -> None:
        self._services = services
        self._api: Api | None = None
        self._loading = asyncio.Lock()

    async def handle(self, request: web.Request) -> web.StreamResponse:
        """Answer a request.

        Raises:
            HTTPException: The path does not exist, or does not have this method.
            MasterError: The request failed.
        """
        async with self._loading:
            if self._api is None:  # in a thread, so that robots and task sets do not wait for it
                self._api = await asyncio.to_thread(_load, self._services)
        return await self._api.handle(request)


def _load(services: Services) -> Api:
    from rce_master.http.api import Api

    return Api(services)
