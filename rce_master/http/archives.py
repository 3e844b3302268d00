"""Archives of packages at a stand-by, for the leading master: ``/archives`` and ``/archives/SHA256``.

Parts of snapshots are below ``/snapshots``.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from aiohttp import hdrs, web

from rce_master.exceptions import MasterError
from rce_master.packages.request_key import HEADER, PATH

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_master.packages.contents import ContentStore
    from rce_master.packages.request_key import RequestKey

_ONE = "/{sha256:[0-9a-f]{64}}"


class ArchiveRoutes:
    """Answers the leading master.

    Args:
        store: Where this master keeps archives.
        key: Tells whether a master asks.
        term: Returns the newest term that this master knows.
        path: Where they are asked for.
    """

    def __init__(
        self, store: ContentStore, key: RequestKey, term: Callable[[], int], path: str = PATH
    ) -> None:
        self._path = path
        self._store = store
        self._key = key
        self._term = term

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

    def _check(self, request: web.Request) -> None:
        """Refuse a peer that is not the leading master.

        Raises:
            HTTPForbidden: It is another program, or a master that led before.
        """
        value = request.headers.get(HEADER, "")
        term = self._key.read(value, request.method or hdrs.METH_GET, request.path)
        if term is None:
            raise web.HTTPForbidden(text="only masters of this engine may ask for this")
        if term < self._term():
            raise web.HTTPForbidden(text=f"term {self._term()} has begun; you ask in term {term}")
