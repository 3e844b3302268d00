"""REST: tokens and users."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_master.auth import client_digest
from rce_master.exceptions import ForbiddenError, InvalidRequestError, NotFoundError, WrongCredentialsError
from rce_master.http import models
from rce_master.http.paging import PAGE, Listing, Span, answer, keys_of
from rce_master.http.routes import Call, route_table
from rce_master.http.views import Views
from rce_master.state import commands
from rce_master.state.user_records import User, UserRole
from rce_master.tokens import new_token, token_digest

if TYPE_CHECKING:
    from aiohttp import web

routes = route_table("account")


@routes.route("POST", "/login", "Get a bearer token", body=models.LoginIn, reply=models.TokenOut, open=True)
async def log_in(call: Call) -> models.TokenOut:
    """Check a password and make a token."""
    body = call.read(models.LoginIn)
    services = call.services
    user = await services.authenticator.verify(body.userID, client_digest(body.password), call.address)
    services.quotas.request(user)
    lifetime = min(body.lifetime or services.token_lifetime, services.token_lifetime)
    token, record = new_token(user.name, body.label, services.clock(), lifetime)
    # A recently used token must not be dropped for this one.
    uses = services.tokens.uses_of(user.name)
    _, outcome = await services.state_service.submit_all(
        [uses, commands.AddToken(token=record, password=user.password)]
    )
    if outcome is not None:
        raise outcome
    return models.TokenOut(
        token=token, userID=user.name, role=user.role.value, expires=record.expires, id=record.id
    )


@routes.route("DELETE", "/login", "Forget the token that this request carries", status=204, any_role=True)
async def log_out(call: Call) -> None:
    """Forget the token."""
    await call.services.state_service.submit(commands.RemoveToken(digest=token_digest(call.token)))


@routes.route("GET", "/user", "Show who you are", reply=models.UserOut, stations=True)
async def show_caller(call: Call) -> models.UserOut:
    """Show the caller."""
    return _views(call).user(call.caller)


@routes.route("GET", "/users", "List all users", reply=models.UsersOut, query=PAGE, admin=True)
async def list_users(call: Call) -> web.Response:
    """List all users."""
    views = _views(call)
    users = call.services.state_service.tables.users

    def items(key: str, span: Span) -> list[tuple[str, models.UserOut]]:
        user = users.get(key)
        return [] if user is None else [(name, views.user(user)) for name in span.of(("",))]

    listing = Listing(
        name="users", whole=lambda: [user.name for user in users], keys=keys_of(users), items=items
    )
    return await answer(call, listing)


@routes.route(
    "POST",
    "/users",
    "Make a user",
    body=models.UserIn,
    reply=models.UserOut,
    status=201,
    admin=True,
    keyed=True,
)
async def add_user(call: Call) -> models.UserOut:
    """Make a user."""
    body = call.read(models.UserIn)
    services = call.services
    digest = client_digest(body.password)
    hashed = await services.authenticator.hash(digest, call.caller.name)
    _check_admin_again(call)
    user = User(name=body.name, role=UserRole(body.role), password=hashed, created=services.clock())
    reply = _views(call).user(user)
    await call.submit(commands.AddUser(user=user), reply)
    await services.authenticator.know(user.name, user.password, digest)
    return reply


@routes.route("DELETE", "/users/{name}", "Remove a user and everything it owns", status=204, admin=True)
async def remove_user(call: Call) -> None:
    """Remove a user."""
    name, service = call.path("name"), call.services.state_service
    leaving = service.tables.users.get(name)
    await service.submit(commands.RemoveUser(name=name))
    while leaving is not None and (there := service.tables.users.get(name)) is not None:
        if there.created != leaving.created:  # another one has this name by now
            break
        await service.submit(commands.RemoveUser(name=name))


@routes.route(
    "PUT",
    "/users/{name}/password",
    "Change a password (your own, or as administrator any user's); ends the user's tokens and sessions",
    body=models.PasswordIn,
    status=204,
    any_role=True,
)
async def set_password(call: Call) -> None:
    """Change a password."""
    name = call.path("name")
    services = call.services
    if name != call.caller.name and not call.is_admin:
        raise ForbiddenError("only an administrator changes another user's password")
    if name not in services.state_service.tables.users:
        raise NotFoundError(f"there is no user {name!r}")
    body = call.read(models.PasswordIn)
    is_own = name == call.caller.name
    former = await _check_old(call, body.old_password) if is_own else ""
    digest = client_digest(body.password)
    hashed = await services.authenticator.hash(digest, call.caller.name)
    if is_own:
        call.check_again()
    else:
        _check_admin_again(call)
    await services.state_service.submit(commands.SetPassword(name=name, password=hashed, former=former))
    await services.authenticator.know(name, hashed, digest)


@routes.route(
    "PUT", "/users/{name}/role", "Change what a user may do", body=models.RoleIn, status=204, admin=True
)
async def set_role(call: Call) -> None:
    """Change a role."""
    role = UserRole(call.read(models.RoleIn).role)
    await call.services.state_service.submit(commands.SetRole(name=call.path("name"), role=role))


async def _check_old(call: Call, password: str) -> str:
    """Check the old password, and return its stored hash.

    The finder of a token must not be able to lock its owner out.
    """
    if not password:
        raise InvalidRequestError(
            "old_password: is missing; to change your own password, give the one until now"
        )
    try:
        digest = client_digest(password)
        user = await call.services.authenticator.verify(call.caller.name, digest, call.address)
    except WrongCredentialsError:
        raise ForbiddenError("old_password: is wrong") from None
    return user.password


def _check_admin_again(call: Call) -> None:
    """Check that the caller is still an administrator, after a password that may have waited to be hashed."""
    if call.check_again().role is not UserRole.ADMIN:
        raise ForbiddenError("only an administrator may do this")


def _views(call: Call) -> Views:
    return Views(call.services.state_service.tables, call.services.reconciler.usage)
