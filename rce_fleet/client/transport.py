"""Sends requests to a station, again if it is safe to do so."""

from __future__ import annotations

import asyncio
import json
import ssl
from collections.abc import AsyncIterator, Mapping
from typing import Any

import aiohttp
from aiohttp import hdrs
from yarl import URL

from rce.aio.backoff import Backoff
from rce.web.client import session_connector
from rce_fleet.client.errors import FleetApiUnavailableError, NotFoundError, error_of

TIMEOUT = aiohttp.ClientTimeout(total=30.0, sock_connect=10.0)
STREAM_TIMEOUT = aiohttp.ClientTimeout(total=None, sock_connect=10.0, sock_read=45.0)
"""The station writes a line every 15 seconds at least."""
RETRY = Backoff(first=0.2, longest=5.0, jitter=0.5)
ATTEMPTS = 6
_BUSY = (429, 502, 503, 504)
"""The station has too much to do or lacks the fleet manager, or a proxy before it lacks the station."""
_REDIRECTS = 300
_ERRORS = 400


class Transport:
    """Requests to one station.

    Args:
        url: URL of the station.
        token: Bearer token; empty for a station without logins.
        tls: Checks the station's certificate; None for the authorities that the system trusts.
        attempts: How often a request is sent that can be repeated.

    Raises:
        ValueError: The URL cannot be that of a station.

    Attributes:
        attempts: The same.
    """

    def __init__(
        self, url: str, token: str = "", *, tls: ssl.SSLContext | None = None, attempts: int = ATTEMPTS
    ) -> None:
        self.attempts = attempts
        self._api = _station(url) / "api/v1"
        self._headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._tls = tls
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
        removes: bool = False,
    ) -> str:
        """Send a request; return the body of the answer.

        Args:
            method: The HTTP method.
            path: Below ``/api/v1``.
            body: JSON; empty: none.
            query: Parameters.
            headers: Further headers.
            repeatable: Whether a second request does no harm, so that it is sent again without an answer.
            removes: Whether one that is sent again and finds nothing was carried out before; the answer is
                empty then.

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
                if not repeatable or attempt >= self.attempts:
                    raise
                await asyncio.sleep(pauses.next())
            except NotFoundError:
                if not removes or attempt == 1:
                    raise
                return ""

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
                self._url(path),
                headers={"Accept": accept, **headers},
                timeout=STREAM_TIMEOUT,
                allow_redirects=False,
            ) as reply:
                if reply.status >= _REDIRECTS:
                    await _checked(reply)
                if reply.content_type != accept:
                    raise FleetApiUnavailableError(
                        f"{self._url(path)} answers with {reply.content_type} instead of {accept}; is the URL"
                        " that of a station, and of the same release?"
                    )
                async for line in reply.content:
                    yield line
        except (aiohttp.ClientError, TimeoutError) as error:
            text = str(error) or "nothing came in time"
            raise FleetApiUnavailableError(f"the stream from {self._api} broke: {text}") from error

    def _url(self, path: str) -> URL:
        return URL(f"{self._api}{path}", encoded=True)


def _station(url: str) -> URL:
    try:
        found = URL(url)
    except ValueError:
        found = URL()
    if found.scheme not in ("http", "https") or not found.host:
        raise ValueError(f"the URL of a station must be such as http://127.0.0.1:9080, not {url!r}")
    return found


async def _checked(reply: aiohttp.ClientResponse) -> str:
    text = await reply.text(errors="replace")
    if reply.status < _REDIRECTS:
        return text
    if reply.status < _ERRORS:  # a change that is sent elsewhere as a GET would look as if it was made
        place = reply.headers.get(hdrs.LOCATION, "another URL")
        raise error_of(
            reply.status, f"nothing was done: {reply.url} leads to {place}; use that station's URL"
        )
    reason = _reason(reply, text)
    if reply.status in _BUSY:
        raise FleetApiUnavailableError(reason)
    raise error_of(reply.status, reason)


def _reason(reply: aiohttp.ClientResponse, text: str) -> str:
    """Return why a request was refused: as the station says, or the status of a proxy before it."""
    try:
        answer: Any = json.loads(text)
    except ValueError:
        is_page = reply.content_type == "text/html"
        return f"{reply.url} answered {reply.status} {reply.reason}" if is_page or not text else text.strip()
    return str(answer.get("error", text)) if isinstance(answer, dict) else text
