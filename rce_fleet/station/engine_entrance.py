"""Lets the engine's users into a station: their tokens are checked at the master."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import ssl
import time
from collections import OrderedDict
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Self, TypedDict

import aiohttp
from aiohttp import hdrs
from yarl import URL

from rce.tls.faults import explain_to_client
from rce.web.client import session_connector
from rce_fleet.station.persons import Action, EntranceError, Person

if TYPE_CHECKING:
    from rce.tls.identity import Context

_log = logging.getLogger(__name__)

FRESH_S = 3.0
"""How long an answer of the master counts; a revoked token is worth nothing after that."""
STALE_S = 30.0
"""How long it counts while the master cannot be reached."""
LIFETIME_S = 12 * 3600.0
"""Of a login at the page."""
MAX_KNOWN = 1000
MAX_NOTES = 1000
_TOLD_ON = {400: 400, 401: 401, 403: 403, 422: 400, 429: 429}
"""Statuses of the master's answer to a login that its caller is told, and by which."""
_ASKED_IN_VAIN = (aiohttp.ClientError, TimeoutError, ValueError, KeyError, AttributeError, TypeError)
"""What asking the master may end with, also if something else answers at its address."""
_TIMEOUT = aiohttp.ClientTimeout(total=10)


class Secure(TypedDict):
    """What each request to the master is made with."""

    ssl: ssl.SSLContext | bool
    allow_redirects: bool


@dataclass(frozen=True, slots=True)
class EngineAccount:
    """The user that the station itself works as."""

    url: str
    """Of the master."""
    user: str
    password: str
    tls: Context | None = None
    """Gives the TLS settings for each connection; the system's if None."""

    @property
    def how(self) -> Secure:
        """How its requests are made: in TLS by the authority as it is now, and never on elsewhere."""
        return Secure(ssl=True if self.tls is None else self.tls(), allow_redirects=False)

    def __repr__(self) -> str:
        return f"EngineAccount(url={self.url!r}, user={self.user!r})"


class EngineEntrance:
    """Asks the master whose a token is. Use it as an asynchronous context manager.

    Args:
        account: Of the station; the fleet is this user's.
        open: Whether who shows no token is taken for the station's own user: for trials on one machine.
    """

    def __init__(self, account: EngineAccount, *, open: bool = False) -> None:  # noqa: A002 - as a door is
        self._account = account
        self._api = URL(account.url) / "api/v1"
        self._open = open
        self._known: OrderedDict[str, tuple[float, Person | None]] = OrderedDict()
        self._notes: asyncio.Queue[tuple[str, Action]] = asyncio.Queue(MAX_NOTES)
        self._own = ""
        self._session: aiohttp.ClientSession
        self._writer: asyncio.Task[None]

    @property
    def has_logins(self) -> bool:
        """Whether people log in here by name and password."""
        return not self._open

    async def __aenter__(self) -> Self:
        """Begin; the master need not be there."""
        connector = session_connector(None)
        self._session = aiohttp.ClientSession(timeout=_TIMEOUT, connector=connector)
        self._writer = asyncio.create_task(self._write_notes())
        return self

    async def __aexit__(self, *_: object) -> None:
        """Give the station's own token back."""
        self._writer.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._writer
        if self._own:
            await self.log_out(self._own)
        await self._session.close()

    async def who(self, token: str) -> Person | None:
        """Return whose token it is.

        Raises:
            EntranceError: The master cannot be reached.
        """
        if not token:
            return Person(self._account.user, "operator", owns=True) if self._open else None
        now = time.monotonic()
        asked, known = self._known.get(token, (0.0, None))
        if token in self._known and now - asked < FRESH_S:
            return known
        try:
            person = await self._ask(token)
        except _ASKED_IN_VAIN as error:
            if token in self._known and known is not None and now - asked < STALE_S:
                return known
            raise EntranceError(
                503,
                f"the engine cannot be reached, so no login can be checked; try again ({_words(error)})",
            ) from error
        self._known[token] = (now, person)
        self._known.move_to_end(token)
        if len(self._known) > MAX_KNOWN:
            self._known.popitem(last=False)
        return person

    async def log_in(self, user: str, password: str, address: str) -> str:
        """Return a token for a user.

        Raises:
            EntranceError: The password is wrong, the user may not see the fleet, or the master is away.
        """
        body = {"userID": user, "password": password, "label": "station page", "lifetime": LIFETIME_S}
        headers = {"X-Forwarded-For": address} if address else {}
        try:
            token = await self._log_in(body, headers)
            person = await self.who(token)
        except _ASKED_IN_VAIN as error:
            raise EntranceError(503, f"the engine cannot be reached; try again ({_words(error)})") from error
        if person is None or not person.sees:
            await self.log_out(token)
            raise EntranceError(403, f"user {user!r} may not see this fleet; an administrator gives the role")
        return token

    async def log_out(self, token: str) -> None:
        """Make a token worthless."""
        self._known.pop(token, None)
        try:
            async with self._session.delete(self._api / "login", headers=_bearer(token), **self._account.how):
                pass  # that it is worthless already is as good
        except (aiohttp.ClientError, TimeoutError) as error:
            _log.warning("a token was not given back, it expires by itself: %s", error)

    def note(self, token: str, action: Action) -> None:
        """Have an action written into the engine's audit log; never waits."""
        try:
            self._notes.put_nowait((token, action))
        except asyncio.QueueFull:
            _log.warning("not in the audit log, too much waits: %s %s", action.name, action.subject)

    async def _ask(self, token: str) -> Person | None:
        async with self._session.get(
            self._api / "user", headers=_bearer(token), **self._account.how
        ) as reply:
            if reply.status in (HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN):
                return None
            reply.raise_for_status()
            found: dict[str, Any] = await reply.json()
        return Person(found["name"], found["role"], owns=found["name"] == self._account.user)

    async def _log_in(self, body: dict[str, Any], headers: dict[str, str]) -> str:
        async with self._session.post(
            self._api / "login", json=body, headers=headers, **self._account.how
        ) as reply:
            answer = await reply.json()
            if reply.status == HTTPStatus.OK:
                return str(answer["token"])
            said = str(answer.get("error", reply.reason))
            if reply.status in _TOLD_ON:
                raise EntranceError(
                    _TOLD_ON[reply.status], said, _seconds(reply.headers.get(hdrs.RETRY_AFTER, ""))
                )
            raise EntranceError(503, f"the engine lets no one log in now: {said}")

    async def _write_notes(self) -> None:
        while True:
            token, action = await self._notes.get()
            try:
                await self._write_note(token, action)
            except (*_ASKED_IN_VAIN, EntranceError) as error:
                _log.warning("not in the audit log: %s %s: %s", action.name, action.subject, error)

    async def _write_note(self, token: str, action: Action) -> None:
        if not token and not self._own:
            account = self._account
            body = {"userID": account.user, "password": account.password, "label": "operator station"}
            self._own = await self._log_in(body, {})
        note = {
            "action": action.name,
            "subject": action.subject[:300],
            "detail": action.detail[:300],
            "address": action.address,
            "outcome": "done" if action.done else "refused",
        }
        headers = _bearer(token or self._own)
        async with self._session.post(
            self._api / "audit", json=note, headers=headers, **self._account.how
        ) as reply:
            if reply.status == HTTPStatus.UNAUTHORIZED and not token:
                self._own = ""
            reply.raise_for_status()


def _words(error: Exception) -> str:
    return explain_to_client(error) or str(error) or "no answer in time"


def _seconds(text: str) -> int:
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= 5 else 0  # noqa: PLR2004 - a day


def _bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}
