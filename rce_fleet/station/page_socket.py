"""A page's WebSocket: changes of the fleet to the page, the layers that it shows from it."""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import TYPE_CHECKING

from aiohttp import WSCloseCode, WSMsgType, web
from pydantic import ValidationError

from rce.aio.tasks import cancel_and_wait
from rce.guard import NoPlaceError
from rce.web.closing import close_socket
from rce_fleet.station.access import USER, problem
from rce_fleet.station.api import LayersRequest
from rce_fleet.station.quotas import why_no_place

if TYPE_CHECKING:
    from rce_fleet.station.access import AccessControl
    from rce_fleet.station.layers.hub import LayerHub
    from rce_fleet.station.live import Broadcast, Page

MAX_MESSAGE = 1 << 16
MIN_FRAME_S = 0.05
"""Minimum time between two batches of messages to one page."""
HEARTBEAT_S = 20.0
CHECK_S = 5.0
"""How often the login of an open page is checked."""


class PageSocket:
    """Handler of ``/live``.

    Args:
        pages: The open pages.
        layers: Sends layers to the pages that ask for them; if None, there are none.
        access: Knows whose login has ended.
    """

    def __init__(self, pages: Broadcast, layers: LayerHub | None, access: AccessControl) -> None:
        self._pages = pages
        self._layers = layers
        self._access = access

    async def handle(self, request: web.Request) -> web.StreamResponse:
        """Send changes to a page until it disconnects.

        Without ``?changes=1`` it gets everything whenever something changes, as pages of 0.1 expect. With
        ``frames=1`` it gets poses in binary frames.
        """
        with contextlib.ExitStack() as place:
            try:
                place.enter_context(self._access.quotas.pages.place(request[USER].name))
            except NoPlaceError as error:
                return problem(429, why_no_place("pages", error), {"Retry-After": "10"})
            return await self._serve(request)

    async def _serve(self, request: web.Request) -> web.StreamResponse:
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, compress=False, max_msg_size=MAX_MESSAGE)
        await socket.prepare(request)
        page = self._pages.open(
            takes_changes=request.query.get("changes") == "1", compact=request.query.get("frames") == "1"
        )
        writer = asyncio.create_task(_write(socket, page))
        watcher = asyncio.create_task(self._close_when_logged_out(socket, request))
        try:
            async for message in socket:
                if message.type is WSMsgType.TEXT and self._layers is not None:
                    _show_layers(self._layers, page, message.data)
        finally:
            self._pages.close(page)
            if self._layers is not None:
                self._layers.leave(page)
            await cancel_and_wait(writer, watcher)
        return socket

    async def _close_when_logged_out(self, socket: web.WebSocketResponse, request: web.Request) -> None:
        """Close a page's socket when its user may not see the fleet any more."""
        while True:
            await asyncio.sleep(CHECK_S)
            if not await self._access.is_still_allowed(request):
                break
        text = "your login has ended; log in again"
        await close_socket(request, socket, code=WSCloseCode.POLICY_VIOLATION, reason=text)


def _show_layers(layers: LayerHub, page: Page, text: str) -> None:
    """Set the layers that a page shows; tell the page if it cannot be read."""
    try:
        wanted = LayersRequest.model_validate_json(text)
    except ValidationError as error:
        fault = f"a page asked for something else than layers: {error.errors()[0]['msg']}"
        page.put_event(json.dumps({"type": "event", "text": fault, "tone": "bad"}))
        return
    layers.show(page, wanted.robot, wanted.layers)


async def _write(socket: web.WebSocketResponse, page: Page) -> None:
    """Send a page's messages, some at a time."""
    with contextlib.suppress(ConnectionError):
        while True:
            for message in await page.take():
                if isinstance(message, bytes):
                    await socket.send_bytes(message)
                else:
                    await socket.send_str(message)
            await asyncio.sleep(MIN_FRAME_S)
