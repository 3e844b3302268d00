"""REST: the limits of a user, and their usage."""

from __future__ import annotations

from rce_master.exceptions import ForbiddenError, NotFoundError
from rce_master.http import models
from rce_master.http.routes import Call, route_table
from rce_master.http.views import Views
from rce_master.limit_values import read_limit
from rce_master.state import commands, limits

routes = route_table("account")


@routes.route(
    "GET",
    "/users/{name}",
    "Show a user (yourself, or as administrator any user) with limits and usage",
    reply=models.UserLimitsOut,
)
async def show_user(call: Call) -> models.UserLimitsOut:
    """Show a user with their limits."""
    name = call.path("name")
    if name != call.caller.name and not call.is_admin:
        raise ForbiddenError("only an administrator sees other users")
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
    command = commands.SetLimits(user=name, limits={kind: read_limit(kind, given[kind]) for kind in given})
    await call.services.state_service.submit(command)
    return _shown(call, name)


def _shown(call: Call, name: str) -> models.UserLimitsOut:
    services = call.services
    tables, settings = services.state_service.tables, services.state_service.state.settings
    user = tables.users.get(name)
    if user is None:
        raise NotFoundError(f"there is no user {name!r}")
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
