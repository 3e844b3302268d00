"""The station's door: who may come in, who may steer, and what is written down of it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping

from aiohttp import hdrs, web

from rce.web.openapi import PREFIX
from rce.web.origin import ServerNames, is_foreign
from rce_fleet.station.persons import Action, Entrance, EntranceError, Person

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

COOKIE = "rce_station"
PERSON, TOKEN = web.RequestKey("person", Person), web.RequestKey("token", str)
_OPEN = ("/login", f"{PREFIX}/login", f"{PREFIX}/openapi.json")
"""What everybody may ask for, beside the files of the pages."""
MAX_TOKEN = 256


class Door:
    """Checks every request.

    Args:
        entrance: Says who somebody is.
        names: By which the station may be asked for.
    """

    def __init__(self, entrance: Entrance, names: ServerNames) -> None:
        self._entrance = entrance
        self._names = names

    @web.middleware
    async def guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Let a request in that may come in."""
        refusal = self._names.refusal(request.headers.get(hdrs.HOST, ""))
        if refusal is not None:
            return problem(421, refusal)
        if is_foreign(request.headers.get(hdrs.ORIGIN), request.host):
            return problem(403, "a page of another site may not use the station")
        if request.path in _OPEN or request.path.startswith("/static/"):
            return await handler(request)
        token = shown_token(request)
        person = await self._entrance.who(token)
        if person is None:
            return self._turn_away(request)
        if not person.sees:
            return problem(403, f"the role {person.role} of user {person.name!r} does not see this fleet")
        request[PERSON], request[TOKEN] = person, token
        response = await handler(request)
        if request.query.get("token") and not response.prepared:
            set_cookie(response, token, secure=request.secure)
        return response

    async def is_still_in(self, request: web.Request) -> bool:
        """Return whether a request that was let in may stay. It may while that cannot be found out."""
        try:
            person = await self._entrance.who(request[TOKEN])
        except EntranceError:
            return True
        return person is not None and person.sees

    def may_steer(self, request: web.Request, name: str, subject: str) -> web.Response | None:
        """Return None if a request's person may steer; else the answer. A refusal is written down."""
        person = request[PERSON]
        if person.steers:
            return None
        self.note(request, name, subject, done=False)
        return problem(403, f"the role {person.role} of user {person.name!r} only looks")

    def note(
        self, request: web.Request, name: str, subject: str, detail: str = "", *, done: bool = True
    ) -> None:
        """Have it written down that somebody steered, or wanted to."""
        action = Action(name, subject, detail, request.remote or "", done)
        self._entrance.note(request[TOKEN], action)

    def _turn_away(self, request: web.Request) -> web.StreamResponse:
        if request.path == "/" and self._entrance.has_logins:
            return web.Response(status=303, headers={hdrs.LOCATION: "/login"})
        if self._entrance.has_logins:
            text = "log in at /login, or show a token of the engine as 'Authorization: Bearer' (rce token)"
        else:
            text = "the station wants its token: as 'Authorization: Bearer', or ?token= once"
        return problem(401, text, {hdrs.WWW_AUTHENTICATE: "Bearer"})


def shown_token(request: web.Request) -> str:
    """Return the token that a request shows; empty: none that could be one."""
    kind, _, bearer = request.headers.get(hdrs.AUTHORIZATION, "").partition(" ")
    shown = bearer.strip() if kind.lower() == "bearer" else ""
    token = shown or request.query.get("token", "") or request.cookies.get(COOKIE, "")
    return token if token.isascii() and token.isprintable() and len(token) <= MAX_TOKEN else ""


def set_cookie(response: web.StreamResponse, token: str, *, secure: bool) -> None:
    """Keep a token in the browser, where no script can read it and no other site can use it."""
    response.set_cookie(COOKIE, token, httponly=True, samesite="Strict", secure=secure)


def problem(status: int, text: str, headers: Mapping[str, str] | None = None) -> web.Response:
    """Return an answer that says what is wrong."""
    return web.json_response({"error": text}, status=status, headers=headers)
