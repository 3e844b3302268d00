"""Archives of packages at a stand-by, for the leading master: ``/archives`` and ``/archives/SHA256``.

Parts of snapshots are below ``/snapshots``.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from aiohttp import web

from rce_master.exceptions import MasterError

if TYPE_CHECKING:
    from rce_master.http.leader_check import LeaderCheck
    from rce_master.packages.contents import ContentStore

_ONE = "/{sha256:[0-9a-f]{64}}"


class ArchiveRoutes:
    """Answers the leading master.

    Args:
        store: Where this master keeps archives.
        check: Refuses others than the leading master.
        path: Where they are asked for.
    """

    def __init__(self, store: ContentStore, check: LeaderCheck, path: str) -> None:
        self._store = store
        self._check = check
        self._path = path

    def add_to(self, app: web.Application) -> None:
        """Add the routes to an application."""
        app.router.add_get(self._path, self._list)
        app.router.add_get(self._path + _ONE, self._give)
        app.router.add_put(self._path + _ONE, self._take)
        app.router.add_delete(self._path + _ONE, self._remove)

    async def _list(self, request: web.Request) -> web.Response:
        self._check(request)
        return web.Response(text="\n".join(await asyncio.to_thread(self._store.held)))

    async def _give(self, request: web.Request) -> web.StreamResponse:
        self._check(request)
        path = self._store.path(request.match_info["sha256"])
        if not await asyncio.to_thread(path.is_file):
            return web.Response(status=404, text="this master does not have it")
        return web.FileResponse(path)

    async def _take(self, request: web.Request) -> web.Response:
        self._check(request)
        sha256 = request.match_info["sha256"]
        try:
            async with self._store.receive(request.content.iter_any()) as incoming:
                if incoming.sha256 != sha256:
                    return web.Response(status=422, text="the archive was changed on its way")
                self._check(request)  # the lead may have changed while it came in
                await self._store.keep(incoming)
        except MasterError as error:
            return web.Response(status=503, text=str(error))
        return web.Response(status=204)

    async def _remove(self, request: web.Request) -> web.Response:
        self._check(request)
        try:
            await asyncio.to_thread(self._store.path(request.match_info["sha256"]).unlink, missing_ok=True)
        except OSError as error:
            return web.Response(status=503, text=f"it cannot be removed: {error.strerror}")
        return web.Response(status=204)
