"""Forwards requests from a stand-by to the leading master, so that clients may know any master."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import aiohttp
from aiohttp import hdrs, web
from multidict import CIMultiDict
from yarl import URL

from rce.tls import CertificateError, explain_to_client
from rce.web.client import UPLOAD_S, Sent, noting_sent
from rce.web.origin import is_foreign
from rce.web.writing import write
from rce_master.http.forwarded import HEADER
from rce_master.leadership.core import STANDBY_HEADER

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from typing import Self

    from multidict import CIMultiDictProxy

    from rce.guard import TrustedProxies
    from rce.tls import Context
    from rce_master.http.forwarded import ForwardingKey
    from rce_master.store.etcd.layout import Leader

_log = logging.getLogger(__name__)

CONNECT_S = 2.0
SILENCE_S = 60.0
"""A leader that says nothing for so long in an answer is given up; streams say something more often. One that
gets an upload has as long as clients wait."""
_OF_CONNECTION = frozenset(
    name.lower()
    for name in (
        *(hdrs.CONNECTION, hdrs.KEEP_ALIVE, hdrs.PROXY_AUTHENTICATE, hdrs.PROXY_AUTHORIZATION, hdrs.TE),
        *(hdrs.TRAILER, hdrs.TRANSFER_ENCODING, hdrs.UPGRADE, hdrs.EXPECT, hdrs.HOST, HEADER),
        *("X-Forwarded-For", "X-Real-IP", "Forwarded", "Via"),
    )
)
"""Headers that are about one connection (RFC 9110, 7.6.1), or tell who sent a request."""
_ADDED = (hdrs.USER_AGENT, hdrs.ACCEPT, hdrs.ACCEPT_ENCODING, hdrs.CONTENT_TYPE)
"""Headers that the library would add."""


_SAFE = (hdrs.METH_GET, hdrs.METH_HEAD)
REPORT_S = 10.0
"""Shortest time from one line of the log about failures to the next: clients may ask often meanwhile."""


class Failures:
    """Logs requests that were not answered, at most one line in a while.

    Args:
        clock: Seconds that never go back.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._next = 0.0
        self._unsaid = 0

    def note(self, text: str) -> None:
        """Log a failure, or count it."""
        if self._clock() < self._next:
            self._unsaid += 1
            return
        _log.info("%s%s", text, f"; so were {self._unsaid} requests before" if self._unsaid else "")
        self._next, self._unsaid = self._clock() + REPORT_S, 0


class NotForwardedError(Exception):
    """A request was not sent to the leading master; another master may do it."""


class Forwarder:
    """Sends requests on to the leading master. Use it as an asynchronous context manager.

    Args:
        key: Tells the leader the client's address.
        proxies: Whose word about that address is taken.
        tls: Gives the TLS context of each connection to a leader that uses TLS.
    """

    def __init__(self, key: ForwardingKey, proxies: TrustedProxies, tls: Context | None = None) -> None:
        self._key = key
        self._proxies = proxies
        self._tls = tls
        self._failures = Failures()
        self._ends: dict[asyncio.Timeout, int] = {}
        """What ends each running request, and the term of the leader that was asked."""
        self._session: aiohttp.ClientSession

    async def __aenter__(self) -> Self:
        self._session = aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(limit=0),
            cookie_jar=aiohttp.DummyCookieJar(),
            auto_decompress=False,
            skip_auto_headers=_ADDED,
            trust_env=False,
            trace_configs=[noting_sent()],
        )
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._session.close()

    def led_by(self, term: int) -> None:
        """End requests whose leader leads no more: it may have vanished, and would be waited for in vain.

        Args:
            term: Of the leading master; 0: none leads.
        """
        now = asyncio.get_running_loop().time()
        for end in [end for end, asked in self._ends.items() if asked != term]:
            del self._ends[end]
            end.reschedule(now)

    @asynccontextmanager
    async def _while_leading(self, leader: Leader) -> AsyncIterator[None]:
        async with asyncio.timeout(None) as end:
            self._ends[end] = leader.term
            try:
                yield
            finally:
                self._ends.pop(end, None)

    async def forward(self, request: web.Request, leader: Leader | None) -> web.StreamResponse:
        """Send a request on, and return the leader's answer.

        Args:
            request: The request; its ``Host`` and ``Origin`` were accepted here.
            leader: The leading master.

        Raises:
            NotForwardedError: The leader did not get it; the text says why.
        """
        if leader is None or not leader.url:
            raise NotForwardedError("no master leads now" if leader is None else f"{leader.name} leads")
        if HEADER in request.headers:
            raise NotForwardedError(f"{leader.name} leads; it is asked by another stand-by")
        if request.headers.get(hdrs.UPGRADE):
            raise NotForwardedError(f"{leader.name} leads; ask it for WebSockets, at {leader.url}")
        response: web.StreamResponse | None = None
        sent = Sent()
        try:
            async with (
                self._while_leading(leader),
                self._session.request(
                    request.method,
                    URL(leader.url.rstrip("/") + request.rel_url.raw_path_qs, encoded=True),
                    headers=self._headers(request, leader),
                    data=request.content if request.body_exists else None,
                    allow_redirects=False,
                    timeout=_timeout(request),
                    ssl=self._tls() if self._tls is not None else True,
                    trace_request_ctx=sent,
                ) as reply,
            ):
                if sent.times > 1 and STANDBY_HEADER in reply.headers:
                    # It did not do the second one, and may have done the first one while it led.
                    return self._broken(request, leader, None, ConnectionError("it leads no more"), sent)
                response = web.StreamResponse(
                    status=reply.status, reason=reply.reason, headers=_without(reply.headers)
                )
                await response.prepare(request)
                async for piece in reply.content.iter_any():
                    await write(request, response, piece)
                await response.write_eof()
        except CertificateError as error:  # of our own files
            raise NotForwardedError(f"{leader.name} leads; {error}") from error
        except (aiohttp.ClientError, TimeoutError, ConnectionError) as error:
            return self._broken(request, leader, response, error, sent)
        return response

    def _broken(
        self,
        request: web.Request,
        leader: Leader,
        response: web.StreamResponse | None,
        error: Exception,
        sent: Sent,
    ) -> web.StreamResponse:
        """Return what a client gets whose request may have been done.

        Raises:
            NotForwardedError: It was not done, or changes nothing.
        """
        if response is not None and response.prepared:
            if request.transport is not None:
                request.transport.abort()  # so that the client does not take the part for the whole
            return response
        distrust = explain_to_client(error)
        why = distrust or str(error) or "it leads no more"
        self._failures.note(f"{request.method} {request.path} was not answered by {leader.name}: {why}")
        if distrust and not sent.begun:
            raise NotForwardedError(f"{leader.name} leads at {leader.url}: {distrust}") from error
        if not sent.begun or request.method in _SAFE:
            raise NotForwardedError(f"{leader.name}, which led until now, does not answer") from error
        text = f"{leader.name}, which led until now, did not answer: it may have done this or not; look first"
        return web.json_response({"error": text}, status=502)

    def _headers(self, request: web.Request, leader: Leader) -> CIMultiDict[str]:
        headers = _without(request.headers)
        if not is_foreign(headers.get(hdrs.ORIGIN), request.headers.get(hdrs.HOST, "")):
            headers.popall(hdrs.ORIGIN, None)  # a page of this server: the leader has another name
        transport = request.transport
        peer = None if transport is None else transport.get_extra_info("peername")
        address = self._proxies.origin(peer, request.headers.getall("X-Forwarded-For", ()))
        headers[HEADER] = self._key.sign(address, leader.term)
        return headers


def _timeout(request: web.Request) -> aiohttp.ClientTimeout:
    is_upload = request.body_exists and request.content_type != "application/json"
    return aiohttp.ClientTimeout(
        total=None, sock_connect=CONNECT_S, sock_read=UPLOAD_S if is_upload else SILENCE_S
    )


def _without(headers: CIMultiDictProxy[str]) -> CIMultiDict[str]:
    """Return headers without those of one connection."""
    named = {word.strip().lower() for word in headers.get(hdrs.CONNECTION, "").split(",")}
    return CIMultiDict(
        (name, value) for name, value in headers.items() if name.lower() not in _OF_CONNECTION | named
    )
