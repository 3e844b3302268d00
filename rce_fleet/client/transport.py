"""Sends requests to a station, again if it is safe to do so."""

from __future__ import annotations

import asyncio
import json
import ssl
from collections.abc import AsyncIterator, Mapping
from typing import Any

import aiohttp
from yarl import URL

from rce.aio.backoff import Backoff
from rce.web.client import session_connector
from rce_fleet.client.errors import FleetApiUnavailableError, error_of

TIMEOUT = aiohttp.ClientTimeout(total=30.0, sock_connect=10.0)
STREAM_TIMEOUT = aiohttp.ClientTimeout(total=None, sock_connect=10.0, sock_read=45.0)
"""The station writes a line every 15 seconds at least."""
RETRY = Backoff(first=0.2, longest=5.0, jitter=0.5)
ATTEMPTS = 6
_BUSY = (429, 503)
_ERRORS = 400


class Transport:
    """Requests to one station.

    Args:
        url: URL of the station.
        token: Bearer token; empty for a station without logins.
        tls: Checks the station's certificate; None for the authorities that the system trusts.
        attempts: How often a request is sent that can be repeated.
    """

    def __init__(
        self, url: str, token: str = "", *, tls: ssl.SSLContext | None = None, attempts: int = ATTEMPTS
    ) -> None:
        self._api = URL(url) / "api/v1"
        self._headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._tls = tls
        self._attempts = attempts
        self._session: aiohttp.ClientSession

    async def open(self) -> None:
        """Open the session."""
        self._session = aiohttp.ClientSession(
            headers=self._headers, timeout=TIMEOUT, connector=session_connector(self._tls)
        )

    async def close(self) -> None:
        """Close the session."""
        await self._session.close()

    async def request(
        self,
        method: str,
        path: str,
        *,
        body: str = "",
        query: Mapping[str, str] | None = None,
        headers: Mapping[str, str] | None = None,
        repeatable: bool = True,
    ) -> str:
        """Send a request; return the body of the answer.

        Args:
            method: The HTTP method.
            path: Below ``/api/v1``.
            body: JSON; empty: none.
            query: Parameters.
            headers: Further headers.
            repeatable: Whether a second request does no harm, so that it is sent again without an answer.

        Raises:
            ApiError: The request was refused.
            FleetApiUnavailableError: There was no answer.
        """
        pauses = RETRY.start()
        attempt = 0
        while True:
            attempt += 1
            try:
                return await self._once(method, path, body, query, headers)
            except FleetApiUnavailableError:
                if not repeatable or attempt >= self._attempts:
                    raise
                await asyncio.sleep(pauses.next())

    async def _once(
        self,
        method: str,
        path: str,
        body: str,
        query: Mapping[str, str] | None,
        headers: Mapping[str, str] | None,
    ) -> str:
        given = {**(headers or {}), **({"Content-Type": "application/json"} if body else {})}
        try:
            async with self._session.request(
                method,
                self._url(path),
                data=body.encode() or None,
                params=query,
                headers=given,
                allow_redirects=False,
            ) as reply:
                return await _checked(reply)
        except (aiohttp.ClientError, TimeoutError) as error:
            text = str(error) or "no answer in time"
            raise FleetApiUnavailableError(f"the station at {self._api} cannot be reached: {text}") from error

    async def stream(self, path: str, *, accept: str, headers: Mapping[str, str]) -> AsyncIterator[bytes]:
        """Read an answer line by line until the station ends it.

        Raises:
            ApiError: The request was refused.
            FleetApiUnavailableError: The stream broke.
        """
        try:
            async with self._session.get(
                self._url(path), headers={"Accept": accept, **headers}, timeout=STREAM_TIMEOUT
            ) as reply:
                if reply.status >= _ERRORS:
                    await _checked(reply)
                async for line in reply.content:
                    yield line
        except (aiohttp.ClientError, TimeoutError) as error:
            raise FleetApiUnavailableError(f"the stream of events broke: {error}") from error

    def _url(self, path: str) -> URL:
        return URL(f"{self._api}{path}", encoded=True)


async def _checked(reply: aiohttp.ClientResponse) -> str:
    text = await reply.text()
    if reply.status < _ERRORS:
        return text
    reason = _reason(text) or str(reply.reason)
    if reply.status in _BUSY:
        raise FleetApiUnavailableError(reason)
    raise error_of(reply.status, reason)


def _reason(text: str) -> str:
    try:
        answer: Any = json.loads(text)
    except ValueError:
        return text.strip()
    return str(answer.get("error", text)) if isinstance(answer, dict) else text
