"""The HTTP server of a master that does not lead: its own role; all else goes to the leader."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from aiohttp import web

from rce.web.origin import ServerNames
from rce_master.http.forward import NotForwardedError
from rce_master.http.health import AGAIN, HEALTH_PATH, describe_role, with_warnings
from rce_master.http.origin_guard import origin_guard
from rce_master.leadership.core import LEADER_HEADER, STANDBY_HEADER

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from typing import Protocol

    from rce_master.follower import StateFollower
    from rce_master.http.forward import Forwarder
    from rce_master.leadership.keeper import LeadershipKeeper

    class Routes(Protocol):
        """Some routes of a server."""

        def add_to(self, app: web.Application) -> None:
            """Add them to an application."""


def make_standby_app(
    keeper: LeadershipKeeper,
    follower: StateFollower,
    forwarder: Forwarder,
    for_leader: Iterable[Routes],
    names: ServerNames | None = None,
    allowed_origins: Iterable[str] = (),
    warnings: Iterable[Callable[[], str]] = (),
) -> web.Application:
    """Make the application of a stand-by.

    Args:
        keeper: Knows who leads.
        follower: Follows the state.
        forwarder: Sends requests on to that master; it is open.
        for_leader: What the leading master asks for.
        names: The allowed host names of the server.
        allowed_origins: Origins of other sites whose pages may use the server.
        warnings: What is added to the status; empty texts are left out.
    """
    standby = _Standby(keeper, follower, forwarder, tuple(warnings))
    app = web.Application(middlewares=[origin_guard(frozenset(allowed_origins), names or ServerNames())])
    app.router.add_get(HEALTH_PATH, standby.health)
    app.router.add_get("/metrics", standby.metrics)
    for one in for_leader:
        one.add_to(app)
    app.router.add_route("*", "/{rest:.*}", standby.forward)
    return app


class _Standby:
    """Answers the requests."""

    def __init__(
        self,
        keeper: LeadershipKeeper,
        follower: StateFollower,
        forwarder: Forwarder,
        warnings: Sequence[Callable[[], str]],
    ) -> None:
        self._warnings = warnings
        self._keeper = keeper
        self._follower = follower
        self._forwarder = forwarder

    async def health(self, _: web.Request) -> web.Response:
        """Tell the role."""
        keeper = self._keeper
        name = "" if keeper.leader is None else keeper.leader.name
        status = keeper.fault or f"stand-by; {f'{name} leads' if name else 'no master leads now'}"
        body = {
            "status": with_warnings(status, self._warnings),
            **describe_role("standby", self._term, name, ready=False, drained=keeper.is_drained),
            "lag": round(self._follower.seconds_behind, 3),
            "lag_revisions": self._follower.lag.revisions,
        }
        return web.json_response(body, status=503, headers=AGAIN)

    async def metrics(self, _: web.Request) -> web.Response:
        """Tell what ``/healthz`` tells everyone: a stand-by has no users, so no tokens."""
        return self._scraped()

    async def forward(self, request: web.Request) -> web.StreamResponse:
        """Let the leader answer."""
        try:
            return await self._forwarder.forward(request, self._keeper.leader)
        except NotForwardedError as error:
            text = f"this master is a stand-by; {self._keeper.fault or error}"
            headers = {**AGAIN, STANDBY_HEADER: "yes"}
            if self._keeper.leader is not None and self._keeper.leader.url:
                headers[LEADER_HEADER] = self._keeper.leader.url
            return web.json_response({"error": text}, status=503, headers=headers)

    @property
    def _term(self) -> int:
        return 0 if self._keeper.leader is None else self._keeper.leader.term

    @cached_property
    def _scraped(self) -> Callable[[], web.Response]:
        from rce_master.http.role_metrics import standby_answer  # only scraped masters spend this memory

        return standby_answer(lambda: self._term, self._follower)
