"""Requests that wait until a password is hashed, while accounts change."""

from __future__ import annotations

import asyncio
import threading
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from argon2 import PasswordHasher

from rce_master.auth import client_digest

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from integration.master.conftest import RunSite, Site

EVE, BOB = ({"name": name, "password": "one", "role": "admin"} for name in ("eve", "bob"))


class PausedHasher(PasswordHasher):
    """Hashes one password only when it is told to."""

    def __init__(self, paused: str) -> None:
        super().__init__(time_cost=1, memory_cost=8, parallelism=1)
        self._paused = client_digest(paused)
        self.reached, self.resume = threading.Event(), threading.Event()

    def hash(self, password: str | bytes, *, salt: bytes | None = None) -> str:
        if password == self._paused:
            self.reached.set()
            self.resume.wait(60)
        return super().hash(password, salt=salt)


class PausedSite:
    """A site with the user eve, an administrator, whose requests with the password ``slow`` wait."""

    def __init__(self, site: Site, hasher: PausedHasher) -> None:
        self.site = site
        self._hasher = hasher

    @asynccontextmanager
    async def request(self, method: str, path: str, body: object, *, status: int) -> AsyncIterator[None]:
        """Let a request of eve's wait to the end of the block; check the status of its answer."""
        token = await self.site.login("eve", "one")
        task = asyncio.create_task(self.site.api(method, path, body, token=token, status=status))
        try:
            assert await asyncio.to_thread(self._hasher.reached.wait, 60)
            yield
        finally:
            self._hasher.resume.set()
            await asyncio.wait([task])
        await task

    async def login_status(self, user: str, password: str) -> int:
        body = {"userID": user, "password": password}
        async with self.site.session.post(f"{self.site.url}api/v1/login", json=body) as reply:
            await reply.read()
            return reply.status

    async def users(self) -> list[Any]:
        return [user["name"] for user in (await self.site.api("GET", "/users"))["users"]]


@asynccontextmanager
async def paused_site(run_site: RunSite) -> AsyncIterator[PausedSite]:
    hasher = PausedHasher("slow")
    async with run_site(hasher=hasher) as site:
        await site.api("POST", "/users", EVE, status=201)
        yield PausedSite(site, hasher)


async def test_reset_defeats_the_users_waiting_change(run_site: RunSite) -> None:
    """One who knows the old password, and lets changes wait, is locked out."""
    async with paused_site(run_site) as paused:
        own = {"password": "slow", "old_password": "one"}
        async with paused.request("PUT", "/users/eve/password", own, status=401):
            await paused.site.api("PUT", "/users/eve/password", {"password": "reset"}, status=204)
        assert await paused.login_status("eve", "slow") == 401
        assert await paused.login_status("eve", "reset") == 200


async def test_successor_of_same_name_keeps_its_password(run_site: RunSite) -> None:
    async with paused_site(run_site) as paused:
        own = {"password": "slow", "old_password": "one"}
        async with paused.request("PUT", "/users/eve/password", own, status=401):
            await paused.site.api("DELETE", "/users/eve", status=204)
            await paused.site.api("POST", "/users", EVE | {"password": "new"}, status=201)
        assert await paused.login_status("eve", "slow") == 401
        assert await paused.login_status("eve", "new") == 200


async def test_administrator_demoted_meanwhile_adds_no_user(run_site: RunSite) -> None:
    async with paused_site(run_site) as paused:
        new = {"name": "eve2", "password": "slow", "role": "admin"}
        async with paused.request("POST", "/users", new, status=403):
            await paused.site.api("PUT", "/users/eve/role", {"role": "user"}, status=204)
        assert await paused.users() == ["testUser", "eve"]


async def test_administrator_removed_meanwhile_adds_no_user(run_site: RunSite) -> None:
    async with paused_site(run_site) as paused:
        new = {"name": "eve2", "password": "slow", "role": "admin"}
        async with paused.request("POST", "/users", new, status=401):
            await paused.site.api("DELETE", "/users/eve", status=204)
        assert await paused.users() == ["testUser"]


async def test_administrator_demoted_meanwhile_resets_none(run_site: RunSite) -> None:
    async with paused_site(run_site) as paused:
        await paused.site.api("POST", "/users", BOB, status=201)
        async with paused.request("PUT", "/users/bob/password", {"password": "slow"}, status=403):
            await paused.site.api("PUT", "/users/eve/role", {"role": "user"}, status=204)
        assert await paused.login_status("bob", "one") == 200
