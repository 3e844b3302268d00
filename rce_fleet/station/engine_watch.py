"""Watches the engine through the master's REST API, for the page."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

import aiohttp
from yarl import URL

from rce.masters import Masters
from rce.tls.faults import explain_to_client
from rce.web.client import session_connector
from rce_fleet.station.engine_authenticator import RequestOptions
from rce_fleet.station.layers.frames import LayerError
from rce_fleet.station.rates import InterfaceRates

if TYPE_CHECKING:
    from rce.tls.identity import Context

_log = logging.getLogger(__name__)

POLL_S = 1.0
RATES_EVERY_S = 5.0
"""How often the counters of all interfaces are read, at most."""
LARGE_PAUSE = 20
"""A list that grows with the fleet is read again after so many times the time that reading it took."""
PAGE_ITEMS = 1000
TIMEOUT = aiohttp.ClientTimeout(total=5)


class EngineWatch:
    """Polls the containers with their usage, the nodes and the connections of the operator's user.

    Args:
        master: URL of the master.
        user: User ID.
        password: The user's password.
        tls: Gives the TLS settings for each connection; the system's if None.
        on_state: Called with each new state of the engine; with ``{"error": text}`` if it cannot be read.
    """

    def __init__(
        self,
        master: str,
        user: str,
        password: str,
        *,
        tls: Context | None = None,
        on_state: Callable[[dict[str, Any]], None],
    ) -> None:
        self._tls = tls
        self._masters = Masters(master)
        self._login = {"userID": user, "password": password, "label": "operator station"}
        self._on_state = on_state
        self._token = ""
        self._last: dict[str, Any] = {}
        self._session: aiohttp.ClientSession | None = None
        self._rates = InterfaceRates()
        self._rates_due = float("-inf")
        self._connections: list[dict[str, Any]] = []
        self._connections_due = float("-inf")

    async def read_items(self, kind: str) -> list[dict[str, Any]]:
        """Return the user's items of a kind from the REST API, such as ``interfaces``.

        Raises:
            LayerError: They cannot be read now.
        """
        if self._session is None or not self._token:
            raise LayerError("the engine's state is not known yet")
        try:
            items: list[dict[str, Any]] = (await self._get(self._session, kind))[kind]
        except (aiohttp.ClientError, TimeoutError) as error:
            raise LayerError(f"the master cannot be asked for {kind}: {error}") from error
        return items

    @property
    def _api(self) -> URL:
        return URL(self._masters.current) / "api/v1"

    @property
    def _request_options(self) -> RequestOptions:
        return RequestOptions(ssl=True if self._tls is None else self._tls(), allow_redirects=False)

    async def run(self) -> None:
        """Watch until cancelled; then revoke the token."""
        connector = session_connector(None)
        async with aiohttp.ClientSession(
            timeout=TIMEOUT, raise_for_status=True, connector=connector
        ) as session:
            self._session = session
            try:
                await self._watch(session)
            finally:
                self._session = None
                await self._log_out(session)

    async def _watch(self, session: aiohttp.ClientSession) -> None:
        while True:
            master = self._masters.current
            try:
                state = await self._read(session)
            except aiohttp.ClientResponseError as error:
                if error.status == HTTPStatus.UNAUTHORIZED:
                    self._token = ""
                if error.status >= HTTPStatus.INTERNAL_SERVER_ERROR:  # another one may have the lead
                    self._masters.failed(master)
                state = {"error": f"the master answered {error.status}: {error.message}"}
            except (aiohttp.ClientError, TimeoutError) as error:
                self._masters.failed(master)
                state = {"error": f"the master cannot be reached: {explain_to_client(error) or error}"}
            except (AttributeError, KeyError, TypeError, ValueError):
                self._token = ""
                self._masters.failed(master)
                state = {"error": f"another program than a master answers at {master}"}
            if "error" in state:
                self._rates_due = self._connections_due = float("-inf")
            if state != self._last:
                self._last = state
                self._on_state(state)
            await asyncio.sleep(POLL_S)

    async def _log_out(self, session: aiohttp.ClientSession) -> None:
        if not self._token:
            return
        headers = {"Authorization": f"Bearer {self._token}"}
        try:
            async with session.delete(self._api / "login", headers=headers, **self._request_options):
                self._token = ""
        except (aiohttp.ClientError, TimeoutError) as error:
            _log.info("the station's token could not be revoked; it expires on its own: %s", error)

    async def _read(self, session: aiohttp.ClientSession) -> dict[str, Any]:
        if not self._token:
            async with session.post(self._api / "login", json=self._login, **self._request_options) as reply:
                self._token = (await reply.json())["token"]
        containers, nodes = [(await self._get(session, kind))[kind] for kind in ("containers", "nodes")]
        usage = await self._get(session, "usage")
        await self._read_large(session)
        used = {container["id"]: container for container in usage["containers"]}
        return {
            "containers": [
                {
                    **{key: container[key] for key in ("tag", "state", "machine", "detail", "moving_to")},
                    **_used(used.get(container["id"])),
                    "nodes": [
                        {key: node[key] for key in ("tag", "state", "detail")}
                        for node in nodes
                        if node["container"] == container["tag"]
                    ],
                }
                for container in containers
            ],
            "connections": [
                {
                    **{key: connection[key] for key in ("tag_a", "tag_b", "established")},
                    **self._rate(connection["tag_a"], connection["tag_b"]),
                }
                for connection in self._connections
            ],
            # Only administrators get machines.
            "machines": [{key: machine[key] for key in _MACHINE} for machine in usage["machines"]],
        }

    async def _read_large(self, session: aiohttp.ClientSession) -> None:
        """Read the lists that grow with the fleet, if they are due."""
        now = asyncio.get_running_loop().time
        if (began := now()) >= self._connections_due:
            self._connections = (await self._get(session, "connections"))["connections"]
            self._connections_due = now() + LARGE_PAUSE * (now() - began)
        if (began := now()) >= self._rates_due:
            self._rates.take(began, (await self._get(session, "interfaces"))["interfaces"])
            self._rates_due = max(began + RATES_EVERY_S, now() + LARGE_PAUSE * (now() - began))

    def _rate(self, tag_a: str, tag_b: str) -> dict[str, float]:
        """Return messages and bytes in a second of a connection; neither before they are known."""
        rate = self._rates.of_connection(tag_a, tag_b)
        return {} if rate is None else {"messages_s": round(rate.messages, 1), "bytes_s": round(rate.bytes)}

    async def _get(self, session: aiohttp.ClientSession, kind: str) -> dict[str, Any]:
        """Read a list page by page; a master of an earlier release answers with all of it at once."""
        name = "containers" if kind == "usage" else kind
        found = page = await self._get_page(session, kind, "")
        while page.get("next"):
            page = await self._get_page(session, kind, page["next"])
            found[name] += page[name]
        return found

    async def _get_page(self, session: aiohttp.ClientSession, kind: str, cursor: str) -> dict[str, Any]:
        headers = {"Authorization": f"Bearer {self._token}"}
        params = {"user": self._login["userID"], "limit": str(PAGE_ITEMS)}
        async with session.get(
            self._api / kind,
            headers=headers,
            params=params | ({"cursor": cursor} if cursor else {}),
            **self._request_options,
        ) as reply:
            found: dict[str, Any] = await reply.json()
            return found


_MACHINE = (
    *("machine", "process", "connected", "draining", "containers"),
    *("slots", "promised_slots", "cores", "promised_cores", "memory", "promised_memory", "advice"),
)
_SHOWN = ("cpu", "cpu_limit", "memory", "memory_limit", "restarts", "oom_kills")


def _used(usage: dict[str, Any] | None) -> dict[str, Any]:
    """Return a container's usage and advice; neither before the first report."""
    if usage is None or not usage["memory"]:
        return {"usage": None, "advice": []}
    return {"usage": {key: usage[key] for key in _SHOWN}, "advice": usage["advice"]}
