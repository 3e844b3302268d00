"""Watches which of several masters leads, for the page; in a demo, a button kills it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

import aiohttp
from aiohttp import web

from rce.masters import split_addresses
from rce.web.routes import Route, RouteTable
from rce_fleet.station.access import AccessControl, problem
from rce_fleet.station.api import Answer

if TYPE_CHECKING:
    from rce.tls.identity import Context

KILL_SIGNAL = signal.SIGUSR1
"""Tells the demo to kill the leading master."""
POLL_S = 0.5
POLL_WITHOUT_LEADER_S = 0.1
_TIMEOUT = aiohttp.ClientTimeout(total=2.0)


class MastersWatch:
    """Asks all masters who leads.

    Args:
        masters: URLs of the masters, separated by commas.
        tls: Gives the TLS settings for each connection; the system's if None.
        on_state: Called with what :func:`masters_text` sends to pages, when it changed.
        kills: Whether a button may kill the leading master.
    """

    def __init__(
        self,
        masters: str,
        *,
        tls: Context | None = None,
        on_state: Callable[[dict[str, Any]], None],
        kills: bool = False,
    ) -> None:
        self._urls = split_addresses(masters)
        self._tls = tls
        self._on_state = on_state
        self._kills = kills
        self._last: dict[str, Any] = {}
        self._term = 0
        self._led_at = 0.0
        self._change: float | None = None
        """How long the last change of the lead took, seconds."""

    async def run(self) -> None:
        """Watch until cancelled."""
        clock = asyncio.get_running_loop().time
        async with aiohttp.ClientSession(timeout=_TIMEOUT) as session:
            while True:
                asked_at = clock()
                told = await asyncio.gather(*(self._ask(session, url) for url in self._urls))
                leads = self._take(told, asked_at, clock())
                await asyncio.sleep(POLL_S if leads else POLL_WITHOUT_LEADER_S)

    def _take(self, told: list[dict[str, Any]], asked_at: float, now: float) -> bool:
        """Take what the masters say; return whether one of them leads."""
        ready = [one for one in told if one["role"] == "leader"]
        leader = max(ready, key=lambda one: int(one["term"]), default=None)
        if leader is not None:
            if self._term and leader["term"] > self._term:
                self._change = now - self._led_at
            if leader["term"] >= self._term:
                self._term, self._led_at = leader["term"], asked_at
        state = {
            "masters": told,
            "term": self._term,
            "change_s": None if self._change is None else round(self._change, 1),
            "kills": self._kills,
        }
        if state != self._last:
            self._last = state
            self._on_state(state)
        return leader is not None

    async def _ask(self, session: aiohttp.ClientSession, url: str) -> dict[str, Any]:
        tls = True if self._tls is None else self._tls()
        with contextlib.suppress(aiohttp.ClientError, OSError, KeyError, TypeError, ValueError):
            async with session.get(f"{url.rstrip('/')}/healthz", ssl=tls, allow_redirects=False) as reply:
                told = await reply.json()
            role = str(told["role"])
            if role == "leader" and not told["ready"]:
                role = "not ready"
            return {"url": url, "role": role, "term": int(told["term"])}
        return {"url": url, "role": "away", "term": 0}


def masters_text(state: dict[str, Any]) -> str:
    """Return the message for pages: which master leads."""
    return json.dumps({"type": "masters", **state}, separators=(",", ":"))


Method = Callable[["MastersRoutes", web.Request], Awaitable[web.StreamResponse]]
ROUTES: RouteTable[Route[Method]] = RouteTable("fleet", Route)
"""Routes of the masters."""


class MastersRoutes:
    """Handlers of these routes.

    Args:
        kill: Kills the leading master; None: this station is not part of a demo with several masters.
        access: Checks what users may do.
    """

    def __init__(self, kill: Callable[[], None] | None, access: AccessControl) -> None:
        self._kill = kill
        self._access = access

    @ROUTES.route(
        "POST",
        "/masters/kill-leader",
        "Kill the leading master, in a demo with several",
        reply=Answer,
        errors=(401, 403, 404, 409, 421, 503),
    )
    async def kill_leader(self, request: web.Request) -> web.StreamResponse:
        """Kill the leading master."""
        refusal = self._access.control_refusal(request, "kill_leader", "masters")
        if refusal is not None:
            return refusal
        if self._kill is None:
            return problem(404, "only in rce demo --replicas 3 a master can be killed")
        try:
            self._kill()
        except ProcessLookupError:
            return problem(409, "the demo that started this station has ended")
        self._access.audit(request, "kill_leader", "masters")
        text = Answer(message="the leading master is being killed").model_dump_json()
        return web.Response(text=text, content_type="application/json")


class DemoProcess:
    """The demo that started this station; it kills the leading master when it gets a signal."""

    def __init__(self) -> None:
        self._pid = os.getppid()

    def kill_leader(self) -> None:
        """Ask for it.

        Raises:
            ProcessLookupError: The demo has ended.
        """
        if os.getppid() != self._pid:
            raise ProcessLookupError(self._pid)
        os.kill(self._pid, KILL_SIGNAL)
