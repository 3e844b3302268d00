"""Writes the changes by requests, and refusals, to the audit log."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_master.exceptions import AuthError, ForbiddenError, MasterError
from rce_master.http.access import owner_of_token

if TYPE_CHECKING:
    from aiohttp import web

    from rce_master.http.routes import Call, Route, Services

_NAMES = ("userID", "tag", "tag_a", "tag_b", "name", "robot", "role", "scope", "draining")
"""Keys of bodies that name objects; all others are left out, because they may hold secrets."""


def note_done(route: Route, call: Call) -> None:
    """Record a request that made a change."""
    if route.method == "GET" or not _is_noted(route):
        return
    audit = call.services.audit
    user = call.user.name if call.user is not None else _claimed(call)
    audit.add(user, _action(route), _subject(call), address=call.address)


def note_refused(route: Route, call: Call, error: MasterError) -> None:
    """Record a request that was refused because of its user. Invalid requests are not recorded."""
    if isinstance(error, AuthError | ForbiddenError) and _is_noted(route):
        user = (
            call.user.name
            if call.user is not None
            else owner_of_token(call.request, call.services) or _claimed(call)
        )
        what = type(error).__name__.removesuffix("Error")
        detail = f"{what} {route.method} {_subject(call)}".rstrip()
        call.services.audit.refuse(user, _action(route), detail=detail, address=call.address)


def note_refused_scrape(request: web.Request, services: Services, error: MasterError) -> None:
    """Record a request for the metrics that was refused because of its token."""
    from rce_master.http.routes import Call  # takes memory, which most masters need not spend

    address = Call(request, services, None, "", None, {}).address
    detail = type(error).__name__.removesuffix("Error")
    services.audit.refuse(owner_of_token(request, services), "get_metrics", detail=detail, address=address)


def _is_noted(route: Route) -> bool:
    return _action(route) != "note_action"


def _action(route: Route) -> str:
    return str(getattr(route.handler, "__name__", route.path))


def _claimed(call: Call) -> str:
    """Return the name of a login if this user exists: an unknown name may be a mistyped password."""
    name = str(getattr(call.body, "userID", ""))
    return name if name in call.services.state_service.tables.users else ""


def _subject(call: Call) -> str:
    owner = call.request.query.get("user", call.user.name if call.user is not None else "")
    words = list(call.parts.values())
    given = call.body.model_dump(include=set(_NAMES), exclude={"userID"}) if call.body is not None else {}
    words += [str(value) for value in given.values()]
    return "/".join((owner, *words)) if words else ""
