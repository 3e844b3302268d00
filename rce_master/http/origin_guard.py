"""Refuses requests of other sites' pages, at leading masters and stand-bys alike."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, TypeAlias

from aiohttp import hdrs, web

from rce.web.origin import ServerNames, is_foreign

Handler: TypeAlias = Callable[[web.Request], Awaitable[web.StreamResponse]]


def origin_guard(allowed: frozenset[str], names: ServerNames) -> Any:
    """Return the middleware.

    Args:
        allowed: Origins of other sites whose pages may use the server.
        names: The allowed host names of the server.
    """

    @web.middleware
    async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse requests of other sites' pages, which a browser would send from the user's network."""
        origin, host = request.headers.get(hdrs.ORIGIN), request.headers.get(hdrs.HOST, "")
        # Robots ask for their endpoint by any name of this server: the answer is not secret.
        refusal = None if origin is None and request.path == "/" else names.refusal(host)
        if refusal is not None and origin not in allowed:
            return web.json_response({"error": refusal}, status=421)
        if is_foreign(origin, host, allowed):
            return web.json_response({"error": f"origin {origin} may not use this server"}, status=403)
        response = await handler(request)
        if origin in allowed and not response.prepared:
            response.headers[hdrs.ACCESS_CONTROL_ALLOW_ORIGIN] = str(origin)
        return response

    return guard
