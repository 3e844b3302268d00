"""The station's access control: checks each request, and records each action in the audit log."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from aiohttp import hdrs, web

from rce.aio.tasks import cancel_and_wait
from rce.web.bodies import read_whole
from rce.web.local import why_not_local
from rce.web.openapi import PREFIX
from rce.web.origin import ServerNames, is_foreign
from rce.web.routes import Route, parameter_fault
from rce_fleet.station.authentication import AuditedAction, AuthenticationError, Authenticator, StationUser
from rce_fleet.station.quotas import StationQuotas

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

USER, TOKEN = web.RequestKey("user", StationUser), web.RequestKey("token", str)
IS_CHECKED = web.RequestKey("is_checked", bool)
"""False: the request may only stop robots, because its token was valid before and cannot be checked now."""
EMERGENCY_STOP = "/emergency-stop"
"""The end of paths of emergency stops."""
STOP_CHECK_S = 0.3
"""How long an emergency stop waits for the check of its token."""
SLOW_BODY_S = 1.0
"""After a body that takes so long, the user is checked again."""
_STOPS = re.compile(rf"{PREFIX}(/robots/[^/]+)?{EMERGENCY_STOP}")
_PUBLIC = ("/login", f"{PREFIX}/login", f"{PREFIX}/openapi.json")
"""Paths that need no token, beside the static files of the pages."""
MAX_TOKEN = 256


class AccessControl:
    """Checks who sends a request and what this user may do.

    Args:
        authenticator: Finds the user of a token.
        names: Host names under which the station may be requested.
        quotas: What one user may ask for.

    Attributes:
        quotas: The same.
    """

    def __init__(
        self, authenticator: Authenticator, names: ServerNames, quotas: StationQuotas | None = None
    ) -> None:
        self.quotas = quotas or StationQuotas()
        self._authenticator = authenticator
        self._names = names
        self.on_audit: Callable[[str, AuditedAction], None] | None = None
        """Called with the user and the action of each entry of the audit log."""

    @web.middleware
    async def check(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Call the handler if the request's user may see the fleet; else return the error response."""
        refusal = self._names.refusal(request.headers.get(hdrs.HOST, ""))
        if refusal is not None:
            return problem(421, refusal)
        if is_foreign(request.headers.get(hdrs.ORIGIN), request.host):
            return problem(403, "requests from pages of other sites are refused")
        if request.path in _PUBLIC or request.path.startswith("/static/"):
            return await handler(request)
        token = token_of(request)
        user, is_left_over = await self._find_user(request, token)
        if user is None:
            return self._unauthorized(request, token)
        if (answer := self._refuse(request, user)) is not None:
            return answer
        request[USER], request[TOKEN] = user, "" if is_left_over else token
        response = await handler(request)
        if is_left_over and not response.prepared:
            delete_cookie(request, response)
        elif request.query.get("token") and not response.prepared:
            set_cookie(request, response, token)
        return response

    async def is_still_allowed(self, request: web.Request, *, to_control: bool = False) -> bool:
        """Return whether an accepted request's user may still see the fleet; True while that is unknown.

        Args:
            request: The request.
            to_control: Whether the user must still be allowed to control the fleet, too.
        """
        try:
            user = await self._authenticator.authenticate(request[TOKEN])
        except AuthenticationError:
            return True
        return user is not None and user.may_view and (user.may_control or not to_control)

    async def read_body(self, request: web.Request) -> bytes:
        """Read an accepted request's body, and check the user again if it came slowly.

        Raises:
            HTTPException: The body is damaged, too large, or did not come in good time.
            AuthenticationError: The user's permission has ended meanwhile.
        """
        began = time.monotonic()
        body = await read_whole(request)
        await self.check_after(request, began)
        return body

    async def check_after(self, request: web.Request, began: float) -> None:
        """Check the user of an accepted request again, if its body came slowly.

        Args:
            request: The request.
            began: When the body was begun to be read, as told by ``time.monotonic``.

        Raises:
            AuthenticationError: The user's permission has ended or changed.
        """
        if time.monotonic() - began < SLOW_BODY_S:
            return
        try:
            user = await self._authenticator.authenticate(request[TOKEN])
        except AuthenticationError:
            return  # it cannot be checked now
        if user != request[USER]:
            raise AuthenticationError(401, "your login has ended, or your role has changed; log in again")

    def control_refusal(self, request: web.Request, name: str, subject: str) -> web.Response | None:
        """Return None if the request's user may control the fleet; else record the refusal and return it."""
        user = request[USER]
        if user.may_control:
            return None
        self.audit(request, name, subject, done=False)
        return problem(403, f"user {user.name!r} has the role {user.role}, which may only see this fleet")

    def audit(
        self, request: web.Request, name: str, subject: str, detail: str = "", *, done: bool = True
    ) -> None:
        """Record an action in the audit log.

        Args:
            request: The request that asked for it.
            name: The action, such as ``set_goal``.
            subject: The robot or cell that it concerns.
            detail: Its parameters, in words.
            done: Whether it was carried out; False if it was refused.
        """
        action = AuditedAction(name, subject, detail, request.remote or "", done)
        self._authenticator.audit(request[TOKEN], action)
        if self.on_audit is not None:
            self.on_audit(request[USER].name, action)

    def _refuse(self, request: web.Request, user: StationUser) -> web.Response | None:
        """Return why a user may not make a request, whatever it asks for; None if they may."""
        if user.is_anonymous and (reason := why_not_local(request)) is not None:
            return self._unauthorized(request, "", f"a request without a login is refused here: {reason}; ")
        if not user.may_view:
            return problem(403, f"user {user.name!r} has the role {user.role}, which may not see this fleet")
        seconds = 0 if _is_stop(request) else self.quotas.request(user)
        if not seconds:
            return None
        text = f"too many requests; try again in {seconds} s"
        return problem(429, text, {hdrs.RETRY_AFTER: str(seconds)})

    async def _find_user(self, request: web.Request, token: str) -> tuple[StationUser | None, bool]:
        """Return the user, and whether the token is a cookie that is not valid at a station without logins.

        A station of another engine may have left it. The user is the one of requests without a token then.

        Raises:
            AuthenticationError: The token cannot be checked now.
        """
        request[IS_CHECKED] = True
        if _is_stop(request):
            user = await self._user_of_stop(request, token)
        else:
            user = await self._authenticator.authenticate(token)
        if user is not None or token != request.cookies.get(cookie_name(request)):
            return user, False
        user = await self._authenticator.authenticate("")
        return user, user is not None

    async def _user_of_stop(self, request: web.Request, token: str) -> StationUser | None:
        """Return the user as last known if the engine does not answer soon: robots can be reached without it.

        Raises:
            AuthenticationError: The token cannot be checked now, and it was not before.
        """
        asking = asyncio.create_task(self._authenticator.authenticate(token))
        try:
            await asyncio.wait({asking}, timeout=STOP_CHECK_S)
            is_answered = asking.done() and not isinstance(asking.exception(), AuthenticationError)
            if not is_answered and (known := self._authenticator.last_known(token)) is not None:
                request[IS_CHECKED] = False
                return known
            return await asking
        finally:
            await cancel_and_wait(asking)

    def _unauthorized(self, request: web.Request, token: str, reason: str = "") -> web.Response:
        if request.path == "/" and self._authenticator.has_logins:
            return web.Response(status=303, headers={hdrs.LOCATION: "/login"})
        if self._authenticator.has_logins:
            text = "log in at /login, or send a token (rce token) as 'Authorization: Bearer TOKEN'"
        elif reason:
            text = "start the station with --token"
        else:
            text = "send the station's token: as 'Authorization: Bearer TOKEN', or once as ?token=TOKEN"
        text = reason + text
        if token:
            text = f"the token is not valid here (it may have ended, or be of another engine): {text}"
        return problem(401, text, {hdrs.WWW_AUTHENTICATE: "Bearer"})


def _is_stop(request: web.Request) -> bool:
    """Return whether a request stops robots, or releases them."""
    return request.method == hdrs.METH_PUT and _STOPS.fullmatch(request.rel_url.raw_path) is not None


def with_known_query(route: Route[Any], handler: Handler) -> Handler:
    """Return a handler that refuses query parameters which its route does not have.

    An emergency stop is carried out whatever is beside it.
    """
    if route.path.endswith(EMERGENCY_STOP):
        return handler

    async def answer(request: web.Request) -> web.StreamResponse:
        fault = parameter_fault(route, request.query.items(), also=("token",))
        return problem(422, fault) if fault else await handler(request)

    return answer


def token_of(request: web.Request) -> str:
    """Return the token of a request; empty if it has none, or one that cannot be valid."""
    scheme, _, bearer = request.headers.get(hdrs.AUTHORIZATION, "").partition(" ")
    given = bearer.strip() if scheme.lower() == "bearer" else ""
    token = given or request.query.get("token", "") or request.cookies.get(cookie_name(request), "")
    return token if token.isascii() and token.isprintable() and len(token) <= MAX_TOKEN else ""


def cookie_name(request: web.Request) -> str:
    """Return the name of the station's cookie: a browser sends a cookie to all ports of a host."""
    port = request.host.rpartition(":")[2]
    return f"rce_station_{port}" if port.isdecimal() else "rce_station"


def set_cookie(request: web.Request, response: web.StreamResponse, token: str) -> None:
    """Store a token in a browser's cookie; scripts cannot read it and other sites cannot send it."""
    name = cookie_name(request)
    response.set_cookie(name, token, httponly=True, samesite="Strict", secure=request.secure)


def delete_cookie(request: web.Request, response: web.StreamResponse) -> None:
    """Have a browser forget the station's cookie."""
    response.del_cookie(cookie_name(request))


def problem(status: int, text: str, headers: Mapping[str, str] | None = None) -> web.Response:
    """Return an error response with a text."""
    return web.json_response({"error": text}, status=status, headers=headers)
