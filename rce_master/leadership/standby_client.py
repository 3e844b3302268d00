"""Requests of the leading master to stand-bys, by HTTP.

The other end checks them (:mod:`rce_master.http.leader_check`).
"""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING

import aiohttp
from yarl import URL

from rce.tls import CertificateError, explain_to_client
from rce_master.leadership.request_key import HEADER

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

    from rce.tls import Context
    from rce_master.leadership.core import Fence
    from rce_master.leadership.request_key import RequestKey
    from rce_master.store.etcd.layout import OtherMaster

CONNECT_S = 2.0
ANSWER_S = 15.0
"""How long a stand-by may take for an answer, beside the transfer."""
MIN_RATE = 1 << 20
"""Bytes per second of a transfer, at least."""


class StandbyError(Exception):
    """Another master did not do what it was asked for; the text says why."""


class StandbyClient:
    """Asks other masters, as the leader of one term.

    Args:
        session: Makes the connections.
        key: Proves that this is a master.
        fence: Of the leadership; nothing is sent after its end.
        tls: Gives the TLS context of each connection to a master that uses TLS.
    """

    def __init__(
        self, session: aiohttp.ClientSession, key: RequestKey, fence: Fence, tls: Context | None = None
    ) -> None:
        self._session = session
        self._key = key
        self._fence = fence
        self._tls = tls

    @asynccontextmanager
    async def ask(
        self,
        master: OtherMaster,
        method: str,
        path: str,
        *,
        query: Mapping[str, str] | None = None,
        size: int = 0,
        data: object = None,
        answer_s: float = ANSWER_S,
        silence_s: float | None = None,
    ) -> AsyncIterator[aiohttp.ClientResponse]:
        """Send a request, and give its answer if that is a success.

        Args:
            master: Whom to ask.
            method: Of HTTP.
            path: What to ask for.
            query: Of the URL.
            size: Bytes that are transferred, at most.
            data: The body.
            answer_s: Seconds that the answer may take, beside connecting and transferring.
            silence_s: Seconds without any of the answer, once all was sent; None: they are not limited apart.

        Raises:
            StandbyError: There was another answer, or none.
            FencedError: This master leads no more.
        """
        self._fence.check()
        url = URL(master.url.rstrip("/") + path).with_query(query)
        try:
            async with (
                asyncio.timeout(CONNECT_S + answer_s + size / MIN_RATE),
                self._session.request(
                    method,
                    url,
                    headers={HEADER: self._key.sign(method, url.raw_path_qs, self._fence.term)},
                    data=data,
                    allow_redirects=False,
                    ssl=self._tls() if self._tls is not None else True,
                    timeout=aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_S, sock_read=silence_s),
                ) as reply,
            ):
                if reply.status not in (HTTPStatus.OK, HTTPStatus.NO_CONTENT):
                    text = (await reply.content.read(300)).decode(errors="replace")
                    raise StandbyError(f"{master.name}: answered {reply.status}: {text}")
                yield reply
        except (aiohttp.ClientError, OSError, CertificateError) as error:  # a time-out is an OSError
            raise failure(master, error) from error


def failure(master: OtherMaster, error: Exception) -> StandbyError:
    """Return what a failed connection means for the one who asked."""
    why = explain_to_client(error) or str(error) or "no answer in time"
    return StandbyError(f"{master.name}: {why}")
