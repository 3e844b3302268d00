"""REST: packages that users bring, and the keys that sign them."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from rce.packages import BadKeyError, key_id
from rce.web.bodies import read_pieces
from rce.web.openapi import Query
from rce_master.exceptions import ForbiddenError, InvalidRequestError, NotFoundError
from rce_master.http import package_models as models
from rce_master.http.paging import ALONE, PAGE, Listing, Span, answer, keys_of_users
from rce_master.http.routes import OF_USER, Call, route_table
from rce_master.packages.service import PushRequest
from rce_master.state import commands
from rce_master.state.packages import find, uses
from rce_master.state.user_records import PackageKey, UserPackage, user_package_key

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from aiohttp import web

    from rce_master.state.tables import Tables

routes = route_table("packages")

_QUERY = (OF_USER,)


@routes.route(
    "GET",
    "/packages",
    "List packages that users brought",
    reply=models.PackagesOut,
    query=(*_QUERY, *PAGE),
)
async def list_packages(call: Call) -> web.Response:
    """List all versions of all packages."""
    tables, scope = call.services.state_service.tables, call.scope
    newest = cache(lambda user, name: find(tables, user, name))

    def whole() -> list[str]:
        return sorted(
            one.id for one in (tables.packages if scope is None else tables.packages.by("user", scope))
        )

    def items(key: str, span: Span) -> list[tuple[str, models.PackageOut]]:
        one = tables.packages.get(key)
        if one is None:
            return []
        shown = _package_out(tables, one, is_newest=newest(one.user, one.name) == one)
        return [(name, shown) for name in span.of(ALONE)]

    keys = keys_of_users(tables, tables.packages, "user", scope)
    return await answer(call, Listing(name="packages", whole=whole, keys=keys, items=items))


@routes.route("GET", "/packages/{name}/{version}", "Show a package", reply=models.PackageOut, query=_QUERY)
async def show_package(call: Call) -> models.PackageOut:
    """Show a version of a package."""
    tables = call.services.state_service.tables
    name, version = call.path("name"), call.path("version")
    found = tables.packages.get(user_package_key(call.owner, name, version))
    if found is None:
        raise NotFoundError(f"there is no package {name!r} of version {version!r}")
    return _shown(tables, found)


@routes.route(
    "PUT",
    "/packages/{name}/{version}",
    "Push a package: the body is its archive",
    reply=models.PackageOut,
    upload="application/gzip",
    query=(
        Query(name="key", description="The public key, in hex, that signed it.", required=True),
        Query(
            name="signature", description="Ed25519, in hex, over what the documentation says.", required=True
        ),
    ),
)
async def push_package(call: Call) -> models.PackageOut:
    """Accept a version of a package; an identical one changes nothing."""
    request = PushRequest(
        user=call.caller.name,
        name=call.path("name"),
        version=call.path("version"),
        key=call.query("key"),
        signature=call.query("signature"),
    )
    size = call.request.content_length or 0
    package, warnings = await call.services.packages.push(request, size, _pieces(call))
    return _shown(call.services.state_service.tables, package, warnings)


async def _pieces(call: Call) -> AsyncIterator[bytes]:
    """Read an archive; refuse it if its sender has lost the permission meanwhile."""
    async for piece in read_pieces(call.request):
        yield piece
    if not call.check_again().role.changes:
        raise ForbiddenError("the role of your account changes nothing any more")


@routes.route(
    "DELETE", "/packages/{name}/{version}", "Remove a version of a package", status=204, query=_QUERY
)
async def remove_package(call: Call) -> None:
    """Remove a version that no node needs."""
    command = commands.RemovePackage(user=call.owner, name=call.path("name"), version=call.path("version"))
    await call.services.state_service.submit(command)


@routes.route(
    "GET",
    "/package-keys",
    "List the keys that sign packages",
    reply=models.PackageKeysOut,
    query=(*_QUERY, *PAGE),
)
async def list_package_keys(call: Call) -> web.Response:
    """List a user's keys."""
    tables, owner = call.services.state_service.tables, call.owner

    def items(key: str, span: Span) -> list[tuple[str, models.PackageKeyOut]]:
        found = tables.package_keys.get(key)
        return [] if found is None else [(name, _key_out(found)) for name in span.of(ALONE)]

    listing = Listing(
        name="keys",
        whole=lambda: list(tables.package_keys.keys("user", owner)),
        keys=keys_of_users(tables, tables.package_keys, "user", owner),
        items=items,
    )
    return await answer(call, listing)


@routes.route(
    "POST",
    "/package-keys",
    "Trust a key that signs your packages",
    body=models.PackageKeyIn,
    reply=models.PackageKeyOut,
    status=201,
    keyed=True,
)
async def register_package_key(call: Call) -> models.PackageKeyOut:
    """Trust a key."""
    body = call.read(models.PackageKeyIn)
    try:
        key_id(body.key)
    except BadKeyError as error:
        raise InvalidRequestError(str(error)) from error
    key = PackageKey(user=call.caller.name, key=body.key, label=body.label, created=call.services.clock())
    reply = _key_out(key)
    await call.submit(commands.AddPackageKey(key=key), reply)
    return reply


@routes.route("DELETE", "/package-keys/{id}", "Trust a key no more", status=204, query=_QUERY)
async def revoke_package_key(call: Call) -> None:
    """Stop trusting a key."""
    await call.services.state_service.submit(commands.RemovePackageKey(user=call.owner, id=call.path("id")))


def _shown(tables: Tables, package: UserPackage, warnings: tuple[str, ...] = ()) -> models.PackageOut:
    is_newest = find(tables, package.user, package.name) == package
    return _package_out(tables, package, is_newest=is_newest, warnings=warnings)


def _package_out(
    tables: Tables, package: UserPackage, *, is_newest: bool, warnings: tuple[str, ...] = ()
) -> models.PackageOut:
    used = uses(tables, package, is_newest=is_newest)
    return models.PackageOut(
        user=package.user,
        name=package.name,
        version=package.version,
        newest=is_newest,
        description=package.description,
        executables=list(package.executables),
        requirements=package.requirements,
        files=package.files,
        size=package.size,
        packed=package.packed,
        sha256=package.sha256,
        digest=package.digest,
        key=key_id(package.key),
        created=package.created,
        nodes=list(used.first),
        node_count=used.count,
        warnings=list(warnings),
    )


def _key_out(key: PackageKey) -> models.PackageKeyOut:
    return models.PackageKeyOut(id=key_id(key.key), key=key.key, label=key.label, created=key.created)
