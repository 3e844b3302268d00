"""Authenticates a station's users at the engine's master, and records their actions in its audit log."""

from __future__ import annotations

import asyncio
import logging
import ssl
import time
from dataclasses import dataclass
from http import HTTPStatus
from math import inf
from typing import TYPE_CHECKING, Any, Self, TypedDict, TypeVar

import aiohttp
from aiohttp import hdrs
from yarl import URL

from rce.aio.tasks import cancel_and_wait
from rce.masters import Masters
from rce.tls.faults import explain_to_client
from rce.web.client import session_connector
from rce_fleet.station.action_queue import ActionQueue, ActionRefusedError, EngineAwayError, QueuedAction
from rce_fleet.station.authentication import AuditedAction, AuthenticationError, StationUser
from rce_fleet.station.token_cache import TokenCache

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rce.tls.identity import Context

_log = logging.getLogger(__name__)

CACHE_S = 3.0
"""How long an answer of the master is cached; a revoked token is refused after that."""
OFFLINE_CACHE_S = 30.0
"""How long it is used while the master cannot be reached."""
LIFETIME_S = 12 * 3600.0
"""Lifetime of a login at the page."""
_PASSED_ON = {400: 400, 401: 401, 403: 403, 422: 400, 429: 429}
"""Status of the master's answer to a login -> status of the station's; all others become 503."""
T = TypeVar("T")
_REQUEST_ERRORS = (aiohttp.ClientError, TimeoutError, ValueError, KeyError, AttributeError, TypeError)
"""Raised by requests to the master, also if another program answers at its address."""
_ENDED = (HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN)
"""The token is not valid any more, or its user may not do this any more."""
_UNSENT = (aiohttp.ClientConnectorError, aiohttp.ConnectionTimeoutError)
_NO_ANSWER = (aiohttp.ClientConnectionError, TimeoutError)
_TIMEOUT = aiohttp.ClientTimeout(total=10)
_TIMEOUT_OF_SEVERAL = aiohttp.ClientTimeout(total=10, sock_connect=2, sock_read=4)
"""For one of several masters: it may be off or hang, and another one lead."""


class RequestOptions(TypedDict):
    """Options of each request to the master."""

    ssl: ssl.SSLContext | bool
    allow_redirects: bool


@dataclass(frozen=True, slots=True)
class StationAccount:
    """The user account of the station itself."""

    url: str
    """URL of the master; several are separated by commas, and are used in turn."""
    user: str
    password: str
    tls: Context | None = None
    """Gives the TLS settings for each connection; the system's if None."""

    @property
    def options(self) -> RequestOptions:
        """TLS settings by the authority file as it is now; redirects are not followed."""
        return RequestOptions(ssl=True if self.tls is None else self.tls(), allow_redirects=False)

    def __repr__(self) -> str:
        return f"StationAccount(url={self.url!r}, user={self.user!r})"


class EngineAuthenticator:
    """Asks the master for the user of a token. An asynchronous context manager.

    Args:
        account: Account of the station; the fleet belongs to this user.
        allow_anonymous: Treat requests without a token as the station's own user, if they are of this
            machine's user.
    """

    has_logins = True

    def __init__(self, account: StationAccount, *, allow_anonymous: bool = False) -> None:
        self._account = account
        self._masters = Masters(account.url)
        self._allow_anonymous = allow_anonymous
        self._cache = TokenCache()
        self._actions = ActionQueue(self._send_action)
        self._own_token = ""
        self._session: aiohttp.ClientSession
        self._writer: asyncio.Task[None]

    @property
    def _api(self) -> URL:
        return URL(self._masters.current) / "api/v1"

    async def __aenter__(self) -> Self:
        """Open the HTTP session; the master may start later."""
        connector = session_connector(None)
        timeout = _TIMEOUT_OF_SEVERAL if self._masters.has_others else _TIMEOUT
        self._session = aiohttp.ClientSession(timeout=timeout, connector=connector)
        self._writer = asyncio.create_task(self._actions.run(), name="actions for the audit log")
        return self

    async def __aexit__(self, *_: object) -> None:
        """Send what the audit log lacks, revoke the station's own token, and close the session."""
        try:
            await self._actions.drain()
        finally:
            await cancel_and_wait(self._writer)
            self._actions.drop()
        if self._own_token:
            await self.log_out(self._own_token)
        await self._session.close()

    async def authenticate(self, token: str) -> StationUser | None:
        """Return the user of a token, or None if the token is not valid.

        Raises:
            AuthenticationError: The master cannot be reached.
        """
        if not token:
            if not self._allow_anonymous:
                return None
            return StationUser(self._account.user, "operator", is_owner=True, is_anonymous=True)
        now = time.monotonic()
        known = self._cache.known(token, now - CACHE_S)
        if known is not None or self._cache.is_refused(token, now - CACHE_S):
            return known
        try:
            user = await self._in_turn(lambda: self._ask(token), reads=True)
        except _REQUEST_ERRORS as error:
            if (known := self._cache.known(token, now - OFFLINE_CACHE_S)) is not None:
                return known
            raise AuthenticationError(
                503,
                f"the engine cannot be reached to check the login; try again ({_reason_of(error)})",
            ) from error
        self._cache.put(token, user, now)
        return user

    def last_known(self, token: str) -> StationUser | None:
        """Return the user of a token as it was last checked; None if it was not, or was not valid then."""
        return self._cache.known(token, time.monotonic() - LIFETIME_S)

    async def log_in(self, user: str, password: str, address: str) -> str:
        """Return a token for a user.

        Raises:
            AuthenticationError: The password is wrong, the user may not see the fleet, or the master cannot
                be reached.
        """
        body = {"userID": user, "password": password, "label": "station page", "lifetime": LIFETIME_S}
        headers = {"X-Forwarded-For": address} if address else {}
        try:
            token = await self._in_turn(lambda: self._log_in(body, headers))
            found = await self.authenticate(token)
        except _REQUEST_ERRORS as error:
            raise AuthenticationError(
                503, f"the engine cannot be reached; try again ({_reason_of(error)})"
            ) from error
        if found is None or not found.may_view:
            await self.log_out(token)
            raise AuthenticationError(
                403,
                f"user {user!r} may not see this fleet; ask an administrator for the role viewer or operator",
            )
        return token

    async def log_out(self, token: str) -> None:
        """Revoke a token."""
        self._cache.forget(token)
        try:
            async with self._session.delete(
                self._api / "login", headers=_bearer(token), **self._account.options
            ):
                pass  # a token that was revoked before is fine too
        except (aiohttp.ClientError, TimeoutError) as error:
            _log.warning("a token could not be revoked; it expires on its own: %s", error)

    def audit(self, token: str, action: AuditedAction) -> None:
        """Queue an action for the engine's audit log. Does not wait."""
        known = self._cache.known(token, -inf)
        self._actions.put(QueuedAction(token, "" if known is None else known.name, action))

    async def _in_turn(self, request: Callable[[], Awaitable[T]], *, reads: bool = False) -> T:
        """Make a request at the master in use, and if it does not get it, at the others in turn.

        Args:
            request: Makes it.
            reads: Whether it changes nothing, so that another master may be asked too if no answer comes.
        """
        for left in range(len(self._masters.all) - 1, -1, -1):
            master = self._masters.current
            try:
                return await request()
            except _REQUEST_ERRORS as error:
                self._masters.failed(master)
                if not left or not (isinstance(error, _UNSENT) or (reads and isinstance(error, _NO_ANSWER))):
                    raise
        raise AssertionError("there is a master at least")

    async def _ask(self, token: str) -> StationUser | None:
        async with self._session.get(
            self._api / "user", headers=_bearer(token), **self._account.options
        ) as reply:
            if reply.status in (HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN):
                return None
            reply.raise_for_status()
            found: dict[str, Any] = await reply.json()
        return StationUser(found["name"], found["role"], is_owner=found["name"] == self._account.user)

    async def _log_in(self, body: dict[str, Any], headers: dict[str, str]) -> str:
        async with self._session.post(
            self._api / "login", json=body, headers=headers, **self._account.options
        ) as reply:
            answer = await reply.json()
            if reply.status == HTTPStatus.OK:
                return str(answer["token"])
            said = str(answer.get("error", reply.reason))
            if reply.status in _PASSED_ON:
                raise AuthenticationError(
                    _PASSED_ON[reply.status], said, _seconds(reply.headers.get(hdrs.RETRY_AFTER, ""))
                )
            raise AuthenticationError(503, f"the engine refuses logins now: {said}")

    async def _send_action(self, queued: QueuedAction) -> None:
        """Note an action in the engine's audit log; by the station itself if the user's token has ended.

        Raises:
            EngineAwayError: The engine does not take it now.
            ActionRefusedError: The engine never takes it.
        """
        detail = queued.action.detail
        if queued.token:
            status = await self._post_action(queued.token, queued.action, detail)
            if status not in _ENDED:
                return
            detail = f"by {queued.user or 'a user'}, whose permission has ended: {detail}"
        for is_last in (False, True):
            status = await self._post_action(await self._log_in_itself(), queued.action, detail)
            if status not in _ENDED:
                return
            self._own_token = ""
            if is_last:
                raise ActionRefusedError(f"the engine refuses the station's own account: {status}")

    async def _log_in_itself(self) -> str:
        if not self._own_token:
            account = self._account
            body = {"userID": account.user, "password": account.password, "label": "operator station"}
            try:
                self._own_token = await self._in_turn(lambda: self._log_in(body, {}))
            except AuthenticationError as error:
                if error.status in _ENDED:
                    raise ActionRefusedError(f"the station's own account: {error}") from error
                raise EngineAwayError(str(error), error.retry_after) from error
            except _REQUEST_ERRORS as error:
                raise EngineAwayError(_reason_of(error)) from error
        return self._own_token

    async def _post_action(self, token: str, action: AuditedAction, detail: str) -> int:
        """Send an action with a token; return the status of the answer, if it was taken or the token was not.

        Raises:
            EngineAwayError: The engine does not take it now.
            ActionRefusedError: The engine never takes it.
        """
        told = {
            "action": action.name,
            "subject": action.subject[:300],
            "detail": detail[:300],
            "address": action.address,
            "outcome": "done" if action.done else "refused",
        }
        try:
            status, text, wait = await self._in_turn(lambda: self._post_audit(token, told))
        except _REQUEST_ERRORS as error:
            raise EngineAwayError(_reason_of(error)) from error
        if status == HTTPStatus.TOO_MANY_REQUESTS or status >= HTTPStatus.INTERNAL_SERVER_ERROR:
            raise EngineAwayError(text, wait)
        if status >= HTTPStatus.BAD_REQUEST and status not in _ENDED:
            raise ActionRefusedError(text)
        return status

    async def _post_audit(self, token: str, told: dict[str, str]) -> tuple[int, str, int]:
        async with self._session.post(
            self._api / "audit", json=told, headers=_bearer(token), **self._account.options
        ) as reply:
            wait = _seconds(reply.headers.get(hdrs.RETRY_AFTER, ""))
            return reply.status, f"{reply.status} {reply.reason}", wait


def _reason_of(error: Exception) -> str:
    return explain_to_client(error) or str(error) or "no answer in time"


def _seconds(text: str) -> int:
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= 5 else 0  # noqa: PLR2004 - a day


def _bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}
