"""REST: tokens of logins, of robots and of programs."""

from __future__ import annotations

from heapq import nsmallest
from typing import TYPE_CHECKING

from rce.model import is_name
from rce_master.exceptions import ForbiddenError, InvalidRequestError
from rce_master.http import models
from rce_master.http.paging import ALONE, PAGE, Listing, Span, answer
from rce_master.http.routes import OF_USER, Call, route_table
from rce_master.state import commands
from rce_master.state.user_records import METRICS_SCOPE, ROBOT_SCOPE, Token
from rce_master.tokens import new_token, token_digest

if TYPE_CHECKING:
    from aiohttp import web

routes = route_table("tokens")

_DAY_S = 24 * 3600.0


_QUERY = (OF_USER, *PAGE)


@routes.route("GET", "/tokens", "List a user's tokens", reply=models.TokensOut, query=_QUERY)
async def list_tokens(call: Call) -> web.Response:
    """List tokens, without their secrets."""
    return await _answer(call, _of(call))


@routes.route(
    "POST",
    "/tokens",
    "Make a token for a program: for metrics (administrators), or for operator stations",
    body=models.ScopedTokenIn,
    reply=models.TokenOut,
    status=201,
    any_role=True,
    query=(OF_USER,),
    keyed=True,
)
async def add_token(call: Call) -> models.TokenOut:
    """Make a token with a scope."""
    body = call.read(models.ScopedTokenIn)
    if body.scope == METRICS_SCOPE and not call.is_admin:
        raise ForbiddenError("only an administrator makes tokens for metrics")
    if call.owner != call.caller.name and not call.is_admin:
        raise ForbiddenError("only an administrator makes tokens of others")
    return await _make(call, call.owner, body.label, body.scope, body.days)


@routes.route(
    "DELETE",
    "/tokens/{id}",
    "Revoke a token; ends what was opened by it",
    status=204,
    any_role=True,
    query=(OF_USER,),
)
async def revoke_token(call: Call) -> None:
    """Revoke a token."""
    await call.services.state_service.submit(commands.RevokeToken(user=call.owner, id=call.path("id")))


@routes.route(
    "GET", "/robot-tokens", "List the tokens of a user's robots", reply=models.TokensOut, query=_QUERY
)
async def list_robot_tokens(call: Call) -> web.Response:
    """List the robots that have a token."""
    return await _answer(call, [token for token in _of(call) if token.robot])


@routes.route(
    "POST",
    "/robot-tokens",
    "Make a token that is good for one robot ID only",
    body=models.RobotTokenIn,
    reply=models.TokenOut,
    status=201,
    query=(OF_USER,),
    keyed=True,
)
async def add_robot_token(call: Call) -> models.TokenOut:
    """Make a robot's token."""
    body = call.read(models.RobotTokenIn)
    if not is_name(body.robot):
        raise InvalidRequestError(
            f"robot: {body.robot!r} is not a robot ID: use letters, digits and '_', beginning with a letter"
        )
    scope = ROBOT_SCOPE + body.robot
    return await _make(call, call.owner, body.label, scope, body.days, replaces=body.replace)


@routes.route(
    "DELETE",
    "/robot-tokens/{robot}",
    "Revoke a robot's token; ends its session",
    status=204,
    query=(OF_USER,),
)
async def revoke_robot_token(call: Call) -> None:
    """Revoke a robot's token."""
    wanted = commands.RevokeRobotToken(user=call.owner, robot=call.path("robot"))
    await call.services.state_service.submit(wanted)


async def _make(
    call: Call, user: str, label: str, scope: str, days: float, *, replaces: bool = False
) -> models.TokenOut:
    services = call.services
    owner = services.state_service.tables.users.get(user)
    if owner is None:
        raise ForbiddenError(f"user {user!r} was removed meanwhile")
    token, record = new_token(user, label, services.clock(), days * _DAY_S, scope=scope)
    reply = models.TokenOut(
        token=token, userID=user, role=owner.role.value, expires=record.expires, id=record.id, scope=scope
    )
    await call.submit(commands.AddToken(token=record, replaces=replaces), reply)
    return reply


async def _answer(call: Call, found: list[Token]) -> web.Response:
    """List tokens: whole in the order in which they were made, pages in that of their ids."""
    tokens = {token.id: token for token in found}

    def keys(start: str, most: int) -> list[str]:
        return nsmallest(most, (id_ for id_ in tokens if id_ >= start))

    def items(key: str, span: Span) -> list[tuple[str, models.TokenListed]]:
        token = tokens.get(key)
        return [] if token is None else [(name, _show(call, token)) for name in span.of(ALONE)]

    return await answer(call, Listing(name="tokens", whole=lambda: list(tokens), keys=keys, items=items))


def _of(call: Call) -> list[Token]:
    if call.owner != call.caller.name and not call.is_admin:
        raise ForbiddenError("only an administrator sees the tokens of others")
    now = call.services.clock()
    found = call.services.state_service.tables.tokens.by("user", call.owner)
    return sorted((token for token in found if not token.is_expired(now)), key=lambda token: token.created)


def _show(call: Call, token: Token) -> models.TokenListed:
    return models.TokenListed(
        id=token.id,
        user=token.user,
        label=token.label,
        scope=token.scope,
        robot=token.robot,
        created=token.created,
        expires=token.expires,
        used=call.services.tokens.last_use(token),
        current=token.digest == token_digest(call.token),
    )
