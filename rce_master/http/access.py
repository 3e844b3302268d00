"""Identifies the user and the address of a request."""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING

from aiohttp import hdrs, web

from rce_master.exceptions import ForbiddenError, WrongCredentialsError
from rce_master.http.forwarded import HEADER
from rce_master.state.user_records import FLEET_SCOPE, METRICS_SCOPE, Token, User, UserRole

if TYPE_CHECKING:
    from rce_master.http.routes import Route, Services


_FORWARDED = ("X-Forwarded-For", "X-Real-IP", "Forwarded", "Via", HEADER)
_GOOD_FOR = {FLEET_SCOPE: "operator stations"}


def bearer(request: web.Request, services: Services, *, stations: bool = False) -> tuple[str, User | None]:
    """Return the token of a request and its user; without one, an empty text and None.

    Args:
        request: The request.
        services: The master's services.
        stations: Whether tokens for operator stations are good for it.

    Raises:
        WrongCredentialsError: The token is unknown or expired.
        ForbiddenError: The token is not for the API.
    """
    token = _token(request)
    if not token:
        return "", None
    user, record = services.tokens.find(token)
    if record.scope and not (stations and record.scope == FLEET_SCOPE):
        what = f"robot {record.robot!r}" if record.robot else _GOOD_FOR.get(record.scope, record.scope)
        raise ForbiddenError(f"this token is good for {what} only; log in for one for the API: rce login")
    return token, user


def owner_of_token(request: web.Request, services: Services) -> str:
    """Return the user of a request's token, whatever the token is good for; empty if it is not valid."""
    try:
        return services.tokens.find(_token(request))[0].name
    except WrongCredentialsError:
        return ""


def admit(route: Route, user: User | None) -> None:
    """Check that a user may use a route.

    Raises:
        WrongCredentialsError: The request is not authenticated, and the route is not public.
        ForbiddenError: The user's role is not enough.
    """
    if user is None and not route.open:
        raise WrongCredentialsError("a bearer token is needed; get one at /api/v1/login")
    if route.admin and (user is None or user.role is not UserRole.ADMIN):
        raise ForbiddenError("only an administrator may do this")
    looks = (route.method == "GET" and not route.acts) or route.any_role or route.open
    if user is not None and not user.role.changes and not looks:
        raise ForbiddenError(
            f"the role {user.role.value} changes nothing; ask an administrator for another one"
        )


def check_metrics(request: web.Request, services: Services) -> None:
    """Check that a request may read the metrics, whose labels name the robots and containers of all users.

    A token is always needed, because requests that a proxy on this machine forwards may look like those of
    local programs. In development mode, programs of this machine do not need a token.

    Raises:
        WrongCredentialsError: The token is missing, unknown or expired.
        ForbiddenError: The token is not for the metrics.
    """
    token = _token(request)
    if not token:
        if services.dev and _is_local(request):
            return
        raise WrongCredentialsError(
            "metrics need a bearer token: of an administrator, or one that is good for nothing else"
            " (rce token new --metrics)"
        )
    user, record = services.tokens.find(token)
    if not _may_read_metrics(user, record):
        raise ForbiddenError("metrics are for administrators, and for tokens of: rce token new --metrics")


def _may_read_metrics(user: User, record: Token) -> bool:
    return user.role is UserRole.ADMIN and record.scope in ("", METRICS_SCOPE)


def _token(request: web.Request) -> str:
    kind, _, token = request.headers.get(hdrs.AUTHORIZATION, "").partition(" ")
    return token.strip() if kind.lower() == "bearer" else ""


def _is_local(request: web.Request) -> bool:
    if any(name in request.headers for name in _FORWARDED):
        return False
    peer = request.transport.get_extra_info("peername") if request.transport else None
    return peer is not None and ipaddress.ip_address(peer[0].partition("%")[0]).is_loopback
