"""The HTTP server of a master that does not lead: its role, and refusals of everything else."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from aiohttp import hdrs, web

from rce.web.origin import ServerNames, is_foreign
from rce_master.http.health import describe_role
from rce_master.leadership.core import STANDBY_HEADER

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_master.leadership.keeper import LeadershipKeeper


def make_standby_app(keeper: LeadershipKeeper, names: ServerNames | None = None) -> web.Application:
    """Make the application of a stand-by.

    Args:
        keeper: Knows who leads.
        names: The allowed host names of the server.
    """
    allowed = names or ServerNames()

    def refused(request: web.Request) -> web.Response | None:
        origin, host = request.headers.get(hdrs.ORIGIN), request.headers.get(hdrs.HOST, "")
        if (refusal := allowed.refusal(host)) is not None:
            return web.json_response({"error": refusal}, status=421)
        if is_foreign(origin, host, frozenset()):
            return web.json_response({"error": f"origin {origin} may not use this server"}, status=403)
        return None

    async def health(request: web.Request) -> web.Response:
        if (refusal := refused(request)) is not None:
            return refusal
        leader = keeper.leader
        term, name = (0, "") if leader is None else (leader.term, leader.name)
        body = {
            "status": keeper.fault or f"stand-by; {_who_leads(keeper)}",
            **describe_role("standby", term, name, ready=False),
        }
        return web.json_response(body, status=503)

    @cache
    def scraped() -> Callable[[], web.Response]:
        from rce_master.http.role_metrics import standby_answer  # only scraped masters spend this memory

        return standby_answer(lambda: 0 if keeper.leader is None else keeper.leader.term)

    async def metrics(request: web.Request) -> web.Response:
        """Tell what ``/healthz`` tells everyone: a stand-by has no users, so no tokens."""
        return refused(request) or scraped()()

    async def refuse(_: web.Request) -> web.Response:
        text = f"this master is a stand-by; {keeper.fault or _who_leads(keeper)}"
        headers = {hdrs.RETRY_AFTER: "1", STANDBY_HEADER: "yes"}
        return web.json_response({"error": text}, status=503, headers=headers)

    app = web.Application()
    app.router.add_get("/healthz", health)
    app.router.add_get("/metrics", metrics)
    app.router.add_route("*", "/{rest:.*}", refuse)
    return app


def _who_leads(keeper: LeadershipKeeper) -> str:
    return "no master leads now" if keeper.leader is None else f"{keeper.leader.name} leads"
