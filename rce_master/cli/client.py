"""A small client of the master's REST API."""

from __future__ import annotations

import asyncio
import contextlib
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO
from urllib.parse import urlsplit

import aiohttp
import msgspec
import typer

from rce.masters import Masters
from rce.tls import CertificateError, client_context, explain_to_client
from rce.web.client import UPLOAD_S, Sent, noting_sent, session_connector
from rce.web.sending import StalledError, watched_body
from rce_master.cli.attempts import NOT_NOW, Attempts
from rce_master.cli.exceptions import ApiError, CliError
from rce_master.events import Event
from rce_master.exceptions import MasterError
from rce_master.leadership.core import LEADER_HEADER, STANDBY_HEADER

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Coroutine, Mapping
    from types import TracebackType
    from typing import Self

    from rce_master.cli.credentials import Credentials

OfUser = Annotated[str, typer.Option("--user", help="Whose; not for role user (default: yourself).")]
OfUserByAdmin = Annotated[str, typer.Option("--user", help="Whose; administrators only (default: yourself).")]

REQUEST_S = 30.0
CONNECT_S = 3.0
"""The same for a connection to one of several masters: a machine that is off answers nothing."""
ANSWER_S = 5.0
"""How long one of several masters may be silent before another one is asked that was not asked yet."""
STREAM_S = 35.0
"""How long a stream of events may be silent; a master writes to it every 15 s."""
RETRY_S = 1.0
IDEMPOTENCY_KEY = "Idempotency-Key"
PAGE_ITEMS = 1000
_OK = 400
_REDIRECTS = 300, 400
_REPEATED = ("GET", "POST")
"""Methods of requests that may be sent again: they change nothing, or are done once by their keys."""
_CLOSE = aiohttp.ClientWSTimeout(ws_close=5.0)


class ApiClient:
    """Talks to a master. Use it as an asynchronous context manager.

    Args:
        url: URL of the master's HTTP server; of several, separated by commas, the first that answers is used.
        token: Bearer token; empty before the login.
        authority: File with the authority that issued the master's certificate; the system's if empty.
    """

    def __init__(self, url: str, token: str = "", *, authority: str = "") -> None:
        self._authority = authority
        self._masters = Masters(url)
        self._headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._answered = ""
        """The master that answered last."""

    @classmethod
    def of(cls, credentials: Credentials) -> ApiClient:
        """Make a client for a login."""
        return cls(credentials.url, credentials.token, authority=credentials.authority)

    async def __aenter__(self) -> Self:
        timeout = aiohttp.ClientTimeout(total=REQUEST_S)
        try:
            tls = client_context(Path(self._authority) if self._authority else None)
        except CertificateError as error:
            raise CliError(str(error)) from error
        connector = session_connector(tls)
        self._session = aiohttp.ClientSession(
            headers=self._headers, timeout=timeout, connector=connector, trace_configs=[noting_sent()]
        )
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._session.close()

    @property
    def _base(self) -> str:
        return f"{self._masters.current.rstrip('/')}/api/v1"

    async def call(
        self,
        method: str,
        path: str,
        body: dict[str, Any] | None = None,
        query: dict[str, str | int] | None = None,
    ) -> Any:
        """Make a request. A POST whose answer is lost is repeated, with the key by which it is done once.

        Only a log-in takes no key: the token of its lost answer expires.

        While the lead changes, it is repeated as long as the masters say that nothing was done. A master that
        does not answer is passed over for the next one; what cannot be repeated is sent to one that answers.

        Returns:
            What came back, or None if nothing did.

        Raises:
            ApiError: The master refused.
            CliError: The master could not be reached.
        """
        if method not in _REPEATED:
            await self._find_master()
        headers = {IDEMPOTENCY_KEY: f'"{uuid.uuid4()}"'} if method == "POST" else {}
        attempts = Attempts(method, len(self._masters.all), asyncio.get_running_loop().time)
        while True:
            if attempts.begin():
                await asyncio.sleep(RETRY_S)
            url = self._masters.current
            sent = Sent()
            try:
                async with self._session.request(
                    method,
                    self._base + path,
                    json=body,
                    params=query,
                    headers=headers,
                    allow_redirects=False,
                    trace_request_ctx=sent,
                    timeout=self._timeout(None if attempts.is_patient else ANSWER_S),
                ) as reply:
                    self._answered = url
                    if not attempts.answered(reply.status, reply.headers):
                        return await _result(reply)
            except (aiohttp.ClientError, TimeoutError, ValueError) as error:
                self._answered = ""
                if not attempts.failed(sent=sent.begun, late=isinstance(error, TimeoutError)):
                    warning = (
                        "; it may have done this or not: look first" if sent.begun and method != "GET" else ""
                    )
                    raise CliError(
                        f"cannot use the master at {self._base}: {_words(error)}{warning}"
                    ) from error
            self._masters.failed(url)

    def _timeout(self, silence: float | None = None) -> aiohttp.ClientTimeout:
        """Return the limits of a request; ``silence`` is that of a pause in its answer, in seconds."""
        connect = CONNECT_S if self._masters.has_others else None
        return aiohttp.ClientTimeout(total=REQUEST_S, sock_connect=connect, sock_read=silence)

    async def _find_master(self) -> None:
        """Turn to a master that answers, for what is sent once only; any answer will do.

        If none answers, the request itself tells why.
        """
        for _ in self._masters.all if self._masters.has_others else ():
            url = self._masters.current
            if url == self._answered:
                return
            try:
                async with self._session.get(
                    f"{url.rstrip('/')}/healthz", allow_redirects=False, timeout=self._timeout(ANSWER_S)
                ):
                    self._answered = url
            except (aiohttp.ClientError, TimeoutError):
                self._masters.failed(url)

    async def items(
        self, path: str, name: str = "", query: dict[str, str | int] | None = None
    ) -> list[dict[str, Any]]:
        """Get a whole list, page by page; a master of an earlier release answers with all of it at once.

        Args:
            path: Its path.
            name: Its field in the answers; empty: that of the path.
            query: Query parameters.

        Raises:
            ApiError: The master refused.
            CliError: The master could not be reached.
        """
        return (await self.pages(path, name or path.strip("/"), query))[1]

    async def pages(
        self, path: str, name: str, query: dict[str, str | int] | None = None
    ) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """Get a whole list as :meth:`items` does; return the first answer too, for its other fields."""
        query = {**(query or {}), "limit": PAGE_ITEMS}
        first = page = await self.call("GET", path, query=query)
        found = list(page[name])
        while page.get("next"):
            page = await self.call("GET", path, query={**query, "cursor": page["next"]})
            found += page[name]
        return first, found

    @contextlib.asynccontextmanager
    async def websocket(
        self, path: str, query: dict[str, str], max_size: int
    ) -> AsyncIterator[aiohttp.ClientWebSocketResponse]:
        """Open a WebSocket.

        Args:
            path: As for :meth:`call`.
            query: Query parameters.
            max_size: Bytes of the longest message that may come.

        Raises:
            ApiError: The master refused.
            CliError: The master could not be reached.
        """
        try:
            async with await self._open_websocket(path, query, max_size) as socket:
                yield socket
        except aiohttp.WSServerHandshakeError as error:
            await self.call("GET", path, query=dict(query))  # says why, which a handshake cannot
            raise ApiError(error.status, error.message) from error
        except (aiohttp.ClientError, TimeoutError) as error:
            raise CliError(f"cannot use the master at {self._base}: {_words(error)}") from error

    async def _open_websocket(
        self, path: str, query: dict[str, str], max_size: int
    ) -> aiohttp.ClientWebSocketResponse:
        """Open a WebSocket at the leading master, which a stand-by names."""
        for number in range(len(self._masters.all), -1, -1):
            await self._find_master()
            url = self._masters.current
            try:
                return await self._session.ws_connect(
                    self._base + path,
                    params=query,
                    max_msg_size=max_size,
                    heartbeat=REQUEST_S,
                    timeout=_CLOSE,
                )
            except (aiohttp.ClientConnectorError, TimeoutError):
                if number <= 1:
                    raise
                self._masters.failed(url)
            except aiohttp.WSServerHandshakeError as error:
                headers: Mapping[str, str] = error.headers or {}
                if number == 0 or STANDBY_HEADER not in headers:
                    raise
                leader = headers.get(LEADER_HEADER, "")
                if leader and urlsplit(leader).scheme == urlsplit(url).scheme:
                    self._masters = Masters((leader, *(one for one in self._masters.all if one != leader)))
                else:
                    self._masters.failed(url)
        raise AssertionError("there is a master at least")

    async def upload(self, path: str, file: BinaryIO, query: dict[str, str]) -> Any:
        """Send a file's contents.

        Returns:
            What came back.

        Raises:
            ApiError: The master refused.
            CliError: The master could not be reached.
        """
        connect = CONNECT_S if self._masters.has_others else REQUEST_S
        timeout = aiohttp.ClientTimeout(total=None, sock_connect=connect, sock_read=UPLOAD_S)
        headers = {"Content-Type": "application/gzip"}
        if self._masters.has_others:
            # A file is sent once; this finds a master that answers.
            await self.call("GET", "/user")
        try:
            async with (
                watched_body(file, stall_s=REQUEST_S, answer_s=UPLOAD_S) as body,
                self._session.put(
                    self._base + path,
                    data=body,
                    params=query,
                    headers=headers,
                    timeout=timeout,
                    allow_redirects=False,
                ) as reply,
            ):
                return await _result(reply)
        except StalledError as error:
            raise CliError(
                f"cannot use the master at {self._base}: {error}; it changed nothing; send the file again"
            ) from error
        except (aiohttp.ClientError, TimeoutError, ValueError) as error:
            raise CliError(f"cannot use the master at {self._base}: {_words(error)}") from error

    async def events(self, since: int | None = None) -> AsyncIterator[Event]:
        """Follow events without end; resume a broken stream where it broke.

        Raises:
            ApiError: The master refused.
            CliError: The master could not be reached at the first attempt.
        """
        last = since
        reached = False
        untried = len(self._masters.all)
        while True:
            url = self._masters.current
            try:
                async for found in self._stream(last):
                    reached = True
                    if isinstance(found, Event):
                        last = found.id
                        yield found
                    else:
                        last = found
                reached = True
            except (aiohttp.ClientError, TimeoutError, ApiError) as error:
                if isinstance(error, ApiError) and error.status not in NOT_NOW:
                    raise
                untried -= 1
                if not reached and last is None and untried <= 0:
                    if isinstance(error, ApiError):
                        raise
                    raise CliError(f"cannot use the master at {self._base}: {_words(error)}") from error
                self._masters.failed(url)
            await asyncio.sleep(RETRY_S)

    async def _stream(self, last: int | None) -> AsyncIterator[Event | int]:
        """Yield events, and the id after which they begin, where a stream without events is resumed."""
        headers = {} if last is None else {"Last-Event-ID": str(last)}
        connect, answer = (CONNECT_S, ANSWER_S) if self._masters.has_others else (REQUEST_S, REQUEST_S)
        timeout = aiohttp.ClientTimeout(total=None, sock_connect=connect, sock_read=STREAM_S)
        async with asyncio.timeout(answer):
            reply = await self._session.get(
                f"{self._base}/events", headers=headers, timeout=timeout, allow_redirects=False
            )
        async with reply:
            if reply.status >= _OK:
                await _result(reply)
            begin: int | None = None
            async for line in reply.content:
                if line.startswith(b"id: ") and (number := line[4:].strip()).isdigit():
                    begin = int(number)
                elif line.startswith(b"data: "):
                    begin = None
                    yield msgspec.json.decode(line[6:], type=Event)
                elif not line.strip() and begin is not None:
                    yield begin
                    begin = None


def _words(error: Exception) -> str:
    return explain_to_client(error) or str(error) or "no answer"


async def _result(reply: aiohttp.ClientResponse) -> Any:
    text = await reply.text()
    if reply.status in range(*_REDIRECTS):
        where = reply.headers.get("Location", "nowhere")
        raise ApiError(reply.status, f"the answer leads to {where}; log in there: rce login URL")
    if reply.status < _OK:
        return msgspec.json.decode(text) if text else None
    with contextlib.suppress(msgspec.MsgspecError, KeyError, TypeError):
        text = msgspec.json.decode(text)["error"]
    raise ApiError(reply.status, text.strip() or str(reply.reason))


def run(work: Coroutine[Any, Any, None]) -> None:
    """Run a command to its end; print why if it fails.

    Raises:
        typer.Exit: It failed, with code 1, or was interrupted, with code 130.
    """
    try:
        asyncio.run(work)
    except (CliError, MasterError) as error:
        typer.echo(f"rce: {error}", err=True)
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        raise typer.Exit(130) from None


def of_user(user: str) -> dict[str, str | int]:
    """Return the query of a request about what belongs to a user; empty: to the caller."""
    return {"user": user} if user else {}
