"""The routes of what is recorded: the span of time, what happened in a part of it, and figures over time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from aiohttp import web
from pydantic import BaseModel, Field

from rce.web.openapi import Query
from rce.web.routes import Route, RouteTable
from rce_fleet.station.access import problem
from rce_fleet.station.figures import columns_of
from rce_fleet.station.recording import FIGURES_LAST_S

if TYPE_CHECKING:
    from rce_fleet.station.recording import Records

MAX_SECONDS = 120.0
MAX_TIME = 1e11
"""Seconds since 1970."""
_ERRORS = (400, 401, 403, 421, 503)

Method = Callable[["ReplayRoutes", web.Request], Awaitable[web.StreamResponse]]
ROUTES: RouteTable[Route[Method]] = RouteTable("fleet", Route)
"""Routes of replays."""


class ReplaySpan(BaseModel):
    """The time that is recorded, seconds since 1970."""

    first: float | None = Field(description="null: nothing is recorded.")
    last: float | None


class ReplayModel(BaseModel):
    """What happened: a complete state, and the changes after it."""

    frames: list[dict[str, Any]] = Field(
        description="Each with time and robots: x, y, yaw, state, cell, goal and the last granted cell;"
        " the first one is whole. blocked and pending are there if they changed."
    )


class FigureHistory(BaseModel):
    """Figures of the fleet over time."""

    times: list[float] = Field(description="Seconds since 1970.")
    figures: dict[str, list[float | None]] = Field(
        description="By name, a value for each time: moving and waiting (robots), and of the fleet manager"
        " battery, utilization (0 .. 1), done (tasks in an hour), open, late (tasks) and wait (seconds)."
    )


class ReplayRoutes:
    """Handlers of these routes.

    Args:
        records: What is recorded; None: nothing.
    """

    def __init__(self, records: Records | None) -> None:
        self._records = records

    @ROUTES.route("GET", "/replay", "The span of time that can be replayed", reply=ReplaySpan, errors=_ERRORS)
    async def get_span(self, request: web.Request) -> web.StreamResponse:
        """Return the recorded span."""
        del request
        span = None if self._records is None else await asyncio.to_thread(self._records.range)
        first, last = span or (None, None)
        return _reply(ReplaySpan(first=first, last=last))

    @ROUTES.route(
        "GET",
        "/replay/{at}",
        "What happened from a time on (seconds since 1970)",
        reply=ReplayModel,
        query=(Query(name="seconds", description="So many seconds. Default: 30.", type="number"),),
        errors=_ERRORS,
    )
    async def get_frames(self, request: web.Request) -> web.StreamResponse:
        """Return the frames of a span."""
        try:
            at = float(request.match_info["at"])
            seconds = float(request.query.get("seconds", "30"))
        except ValueError as error:
            return problem(400, f"expected numbers of seconds: {error}")
        if not (0 <= at < MAX_TIME and 0 <= seconds <= MAX_SECONDS):
            return problem(400, f"expected a time since 1970, and at most {MAX_SECONDS:g} seconds")
        frames = [] if self._records is None else await asyncio.to_thread(self._records.read, at, seconds)
        return _reply(ReplayModel(frames=frames))

    @ROUTES.route(
        "GET",
        "/figures",
        "Figures of the last time",
        reply=FigureHistory,
        query=(Query(name="seconds", description="The last so many seconds. Default: 3600.", type="number"),),
        errors=_ERRORS,
    )
    async def get_figures(self, request: web.Request) -> web.StreamResponse:
        """Return figures over time."""
        try:
            seconds = float(request.query.get("seconds", "3600"))
        except ValueError as error:
            return problem(400, f"expected a number of seconds: {error}")
        if not 0 <= seconds <= FIGURES_LAST_S:
            return problem(400, f"expected at most {FIGURES_LAST_S:g} seconds")
        since = time.time() - seconds
        samples = [] if self._records is None else await asyncio.to_thread(self._records.figures, since)
        times, figures = columns_of(samples)
        return _reply(FigureHistory(times=times, figures=figures))


def _reply(model: BaseModel) -> web.Response:
    return web.Response(text=model.model_dump_json(), content_type="application/json")
