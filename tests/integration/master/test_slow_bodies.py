"""Requests whose bodies come slowly, while their callers lose the permission."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from integration.master.conftest import RunSite, Site

NEW = {"name": "eve2", "password": "pw", "role": "admin"}


async def post_slowly(site: Site, token: str, body: object, meanwhile: Callable[[], Awaitable[Any]]) -> int:
    """Post to ``/users``; do something before the last byte. Returns the status."""
    begun = asyncio.Event()

    async def pieces() -> AsyncIterator[bytes]:
        text = json.dumps(body).encode()
        yield text[:-1]
        await asyncio.sleep(0.1)  # the master reads the request's headers
        begun.set()
        await meanwhile()
        yield text[-1:]

    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
    async with site.session.post(f"{site.url}api/v1/users", data=pieces(), headers=headers) as reply:
        await reply.read()
        assert begun.is_set()
        return reply.status


async def test_who_was_removed_meanwhile_changes_nothing(site: Site) -> None:
    await site.api("POST", "/users", {"name": "eve", "password": "pw", "role": "admin"}, status=201)
    eve = await site.login("eve", "pw")
    assert await post_slowly(site, eve, NEW, lambda: site.api("DELETE", "/users/eve", status=204)) == 401
    await site.api("GET", "/users/eve2", status=404)


async def test_who_lost_the_role_meanwhile_changes_nothing(site: Site) -> None:
    await site.api("POST", "/users", {"name": "eve", "password": "pw", "role": "admin"}, status=201)
    eve = await site.login("eve", "pw")
    demote = lambda: site.api("PUT", "/users/eve/role", {"role": "user"}, status=204)  # noqa: E731 - short
    assert await post_slowly(site, eve, NEW, demote) == 403
    await site.api("GET", "/users/eve2", status=404)


async def test_other_changes_of_the_account_do_not_matter(run_site: RunSite) -> None:
    async with run_site() as site:
        limit = lambda: site.api("PATCH", "/users/testUser/limits", {"containers": 7})  # noqa: E731 - short
        assert await post_slowly(site, site.token, NEW, limit) == 201
