"""A station's access control that lets all requests in, for tests of single handlers."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from aiohttp import web

from rce.guard import Places
from rce_fleet.station.access import USER
from rce_fleet.station.authentication import StationUser
from rce_fleet.station.quotas import StationQuotas


class OpenAccess:
    """Lets all of them in, as one user.

    Args:
        streams: Places for streams.
    """

    def __init__(self, streams: int = 10) -> None:
        self.quotas = StationQuotas()
        self.quotas.streams = Places(each=streams)

    async def is_still_allowed(self, request: web.Request) -> bool:
        del request
        return True


@web.middleware
async def name_user(
    request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
) -> web.StreamResponse:
    """Say that all requests are of one viewer."""
    request[USER] = StationUser("anna", "viewer")
    return await handler(request)
