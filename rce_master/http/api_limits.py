"""REST: what a user may have, and what of it is used."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.protocol.quantities import read_cores, read_memory
from rce_master.exceptions import Forbidden, Invalid, NotFound
from rce_master.http import models
from rce_master.http.routes import Call, RouteTable
from rce_master.http.views import Views
from rce_master.state import commands, limits

if TYPE_CHECKING:
    from collections.abc import Callable

routes = RouteTable("account")

_DEFAULT = "default"


def _count(value: object) -> float:
    if isinstance(value, str) and value.isascii() and value.isdecimal():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= _MOST:
        raise ValueError(f"must be a whole number from 0 to {_MOST}, or {_DEFAULT}")
    return value


_MOST = 10**9
_READERS: dict[str, Callable[[object], float]] = {
    "cpu": read_cores,
    "memory": read_memory,
    "disk": read_memory,
}


@routes.route(
    "GET",
    "/users/{name}",
    "Show a user (yourself, or anybody as administrator), what they may have and what they have",
    reply=models.UserLimitsOut,
)
async def show_user(call: Call) -> models.UserLimitsOut:
    """Show a user with their limits."""
    name = call.path("name")
    if name != call.caller.name and not call.is_admin:
        raise Forbidden("only an administrator sees other users")
    return _shown(call, name)


@routes.route(
    "PATCH",
    "/users/{name}/limits",
    "Change what a user may have; what is there stays",
    body=models.LimitsIn,
    reply=models.UserLimitsOut,
    admin=True,
)
async def set_limits(call: Call) -> models.UserLimitsOut:
    """Change limits."""
    name = call.path("name")
    given = call.read(models.LimitsIn).model_dump(exclude_none=True)
    command = commands.SetLimits(user=name, limits={kind: _read(kind, given[kind]) for kind in given})
    await call.services.realm.submit(command)
    return _shown(call, name)


def _read(kind: str, value: object) -> float | None:
    if value == _DEFAULT:
        return None
    try:
        return _READERS.get(kind, _count)(value)
    except ValueError as error:
        raise Invalid(f"{kind}: {error}") from None


def _shown(call: Call, name: str) -> models.UserLimitsOut:
    services = call.services
    tables, settings = services.realm.tables, services.realm.state.settings
    user = tables.users.get(name)
    if user is None:
        raise NotFound(f"there is no user {name!r}")
    used = limits.used_of(tables, name)
    found = (limits.limit_of(tables, settings, name, kind) for kind in limits.KINDS)
    known = Views(tables, services.reconciler.usage).user(user)
    return models.UserLimitsOut(
        **known.model_dump(),
        limits={
            limit.kind: models.LimitOut(limit=limit.most, used=used[limit.kind], source=limit.source)
            for limit in found
        },
    )
