"""Asks another master for its role."""

from __future__ import annotations

import asyncio
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

import aiohttp

if TYPE_CHECKING:
    from rce.tls import Context
    from rce_master.store.etcd.layout import OtherMaster

ANSWER_S = 1.0


class Probe:
    """Tells what other masters are doing.

    Args:
        session: Makes the connections.
        tls: Gives the TLS context of each connection to a master that uses TLS.
    """

    def __init__(self, session: aiohttp.ClientSession, tls: Context | None = None) -> None:
        self._session = session
        self._tls = tls

    async def stands_by(self, master: OtherMaster) -> bool:
        """Return whether a master answers that it is a stand-by and reaches etcd."""
        status, told = await self._ask(master)
        return (
            status == HTTPStatus.SERVICE_UNAVAILABLE
            and told.get("role") == "standby"
            and bool(told.get("leader"))
        )

    async def answers(self, master: OtherMaster) -> bool:
        """Return whether a master runs at an address, in whichever role."""
        _, told = await self._ask(master)
        return bool(told.get("role"))

    async def _ask(self, master: OtherMaster) -> tuple[int, dict[str, Any]]:
        """Return the status and the content of an answer; 0 and nothing if there is none."""
        try:
            async with (
                asyncio.timeout(ANSWER_S),
                self._session.get(
                    f"{master.url.rstrip('/')}/healthz",
                    allow_redirects=False,
                    ssl=self._tls() if self._tls is not None else True,
                ) as reply,
            ):
                told = await reply.json()
                return (reply.status, told) if isinstance(told, dict) else (0, {})
        except (aiohttp.ClientError, OSError, ValueError):
            return 0, {}  # also after a time-out, which is an OSError
