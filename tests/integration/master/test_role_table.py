"""Which roles may use which route of the REST API, of all routes."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from rce_master.http.api import ROUTES

if TYPE_CHECKING:
    from integration.master.conftest import Site

OPEN = {"POST /login"}
"""For requests without a token, too."""
VIEWERS = {
    "DELETE /login",
    "GET /user",
    "GET /users/{name}",
    "PUT /users/{name}/password",
    "GET /tokens",
    "POST /tokens",
    "DELETE /tokens/{id}",
    "GET /robot-tokens",
    "POST /audit",
    "GET /robots",
    "GET /containers",
    "GET /nodes",
    "GET /parameters",
    "GET /interfaces",
    "GET /connections",
    "GET /usage",
    "GET /usage/live",
    "GET /packages",
    "GET /packages/{name}/{version}",
    "GET /package-keys",
    "GET /volumes",
    "GET /states",
    "GET /containers/{container}/log",
    "GET /containers/{container}/nodes/{node}/log",
    "GET /events",
}
"""For all roles; what is in their answers depends on the role."""
USERS = {
    "POST /robot-tokens",
    "DELETE /robot-tokens/{robot}",
    "POST /containers",
    "PATCH /containers/{container}",
    "DELETE /containers/{container}",
    "GET /containers/{container}/exec",
    "POST /containers/{container}/nodes",
    "DELETE /containers/{container}/nodes/{node}",
    "PUT /containers/{container}/parameters",
    "DELETE /containers/{container}/parameters",
    "POST /endpoints/{endpoint}/interfaces",
    "DELETE /endpoints/{endpoint}/interfaces/{interface}",
    "POST /connections",
    "DELETE /connections",
    "PUT /packages/{name}/{version}",
    "DELETE /packages/{name}/{version}",
    "POST /package-keys",
    "DELETE /package-keys/{id}",
    "DELETE /volumes/{name}",
    "DELETE /states/{container}/{node}",
}
"""For all roles but viewers."""
ADMINISTRATORS = {
    "GET /users",
    "POST /users",
    "DELETE /users/{name}",
    "PUT /users/{name}/role",
    "PATCH /users/{name}/limits",
    "GET /audit",
    "GET /machines",
    "PUT /machines/{machine}/drain",
    "DELETE /machines/{machine}/drain",
    "PUT /containers/{container}/machine",
    "GET /masters",
}
STATIONS = {"GET /user", "POST /audit"}
"""For tokens of operator stations."""
ALL = OPEN | VIEWERS | USERS | ADMINISTRATORS
ALLOWED = {
    "viewer": OPEN | VIEWERS,
    "user": OPEN | VIEWERS | USERS,
    "operator": OPEN | VIEWERS | USERS,
    "admin": ALL,
}


async def admitted(site: Site, token: str, refusal: int) -> set[str]:
    """Return the routes that a caller may use; the others must answer with the given status.

    The requests change nothing: a caller who may use the route has an unknown query parameter.
    """
    found = set()
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    for route in ROUTES:
        path = re.sub(r"\{\w+\}", "x", route.path)
        url = f"{site.url}api/v1{path}?unknown=1"
        async with site.session.request(route.method, url, headers=headers) as reply:
            name, text = f"{route.method} {route.path}", await reply.text()
            if "is unknown here" in text:
                assert reply.status == 422, (name, text)
                found.add(name)
            else:
                assert reply.status == refusal, (name, text)
    return found


async def login_of(site: Site, role: str) -> str:
    body = {"name": role, "password": "pw", "role": role}
    await site.api("POST", "/users", body, status=201)
    return await site.login(role, "pw")


def test_each_route_has_a_row_with_its_roles() -> None:
    assert {f"{route.method} {route.path}" for route in ROUTES} == ALL
    assert len(ROUTES) == len(OPEN) + len(VIEWERS) + len(USERS) + len(ADMINISTRATORS)


@pytest.mark.parametrize("role", ALLOWED)
async def test_a_role_may_use_its_routes_and_no_others(site: Site, role: str) -> None:
    assert await admitted(site, await login_of(site, role), 403) == ALLOWED[role]


async def test_only_a_login_needs_no_token(site: Site) -> None:
    assert await admitted(site, "", 401) == OPEN


async def test_a_station_token_is_for_stations_only(site: Site) -> None:
    """Also that of an administrator."""
    token = await login_of(site, "admin")
    made = await site.api("POST", "/tokens", {"scope": "fleet"}, token=token, status=201)
    assert await admitted(site, made["token"], 403) == STATIONS
