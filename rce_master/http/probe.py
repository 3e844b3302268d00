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
    """Tells whether other masters stand by.

    Args:
        session: Makes the connections.
        tls: Gives the TLS context of each connection to a master that uses TLS.
    """

    def __init__(self, session: aiohttp.ClientSession, tls: Context | None = None) -> None:
        self._session = session
        self._tls = tls

    async def stands_by(self, master: OtherMaster) -> bool:
        """Return whether a master answers that it is a stand-by and reaches etcd."""
        try:
            async with (
                asyncio.timeout(ANSWER_S),
                self._session.get(
                    f"{master.url.rstrip('/')}/healthz",
                    allow_redirects=False,
                    ssl=self._tls() if self._tls is not None else True,
                ) as reply,
            ):
                told: dict[str, Any] = await reply.json()
                return (
                    reply.status == HTTPStatus.SERVICE_UNAVAILABLE
                    and told["role"] == "standby"
                    and bool(told["leader"])
                )
        except (aiohttp.ClientError, OSError, ValueError, KeyError, TypeError):
            return False  # also a time-out, which is an OSError
