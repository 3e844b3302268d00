"""The audit log of a stand-by, for the leading master: ``GET /audit?since=&limit=&user=``."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import msgspec
from aiohttp import web

from rce_master.audit import choose, newest
from rce_master.other_audits import PATH

if TYPE_CHECKING:
    from pathlib import Path

    from rce_master.http.leader_check import LeaderCheck


class AuditRoute:
    """Gives the records that this master wrote when it led.

    Args:
        folder: Of the audit log's files.
        check: Refuses others than the leading master.
    """

    def __init__(self, folder: Path, check: LeaderCheck) -> None:
        self._folder = folder
        self._check = check

    def add_to(self, app: web.Application) -> None:
        """Add the route to an application."""
        app.router.add_get(PATH, self._give)

    async def _give(self, request: web.Request) -> web.Response:
        self._check(request)
        query = request.query
        try:
            since, limit = int(query["since"]), int(query["limit"])
        except (KeyError, ValueError) as error:
            raise web.HTTPBadRequest(text=f"since and limit must be integers: {error}") from error
        body = await asyncio.to_thread(self._read, since, limit, query.get("user", ""))
        return web.Response(body=body, content_type="application/json")

    def _read(self, since: int, limit: int, user: str) -> bytes:
        return msgspec.json.encode(choose(newest(self._folder), since, limit, user))
