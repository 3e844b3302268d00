"""Strangers who guess passwords, over real sockets."""

from __future__ import annotations

import asyncio
import signal
from typing import TYPE_CHECKING, Any

import aiohttp
from support.master_program import master

from rce_master.auth import client_digest

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager
    from pathlib import Path

    from conftest import Site

    RunSite = Callable[..., AbstractAsyncContextManager[Site]]

GUESSES = 40
RIGHT = "testUser"
HOME, BAD, ELSEWHERE = "127.0.0.1", "127.0.0.66", "127.0.0.7"


async def log_in(
    url: str, password: str, address: str = HOME, user: str = "testUser", **headers: str
) -> tuple[int, Any]:
    """Log in from an address of the loopback; returns the status and ``Retry-After``."""
    connector = aiohttp.TCPConnector(local_addr=(address, 0))
    async with (
        aiohttp.ClientSession(connector=connector, headers=headers) as session,
        session.post(f"{url}api/v1/login", json={"userID": user, "password": password}) as reply,
    ):
        return reply.status, reply.headers.get("Retry-After")


async def guess(url: str, address: str, **headers: str) -> list[int]:
    tries = (log_in(url, f"guess {number}", address, **headers) for number in range(GUESSES))
    return [status for status, _ in await asyncio.gather(*tries)]


async def test_guesses_lock_nobody_out_who_is_right(tmp_path: Path) -> None:
    """Over kill -9 of the real master, from the address of the guesses too."""
    async with master(tmp_path, "--dev", end=signal.SIGKILL) as url:
        assert (await log_in(url, RIGHT))[0] == 200
    async with master(tmp_path, "--dev") as url:
        found = await guess(url, HOME)
        assert set(found) == {401, 429}
        status, wait = await log_in(url, "one more guess")
        assert (status, wait is not None) in ((429, True), (401, False))
        assert (await log_in(url, RIGHT))[0] == 200


async def test_guesses_from_one_address_hold_up_no_other(run_site: RunSite) -> None:
    """The master starts with no memory of any password."""
    async with run_site(log_in=False) as site:
        bad = asyncio.gather(*(guess(site.url, BAD) for _ in range(5)))
        assert (await log_in(site.url, RIGHT, ELSEWHERE))[0] == 200
        assert {status for found in await bad for status in found} <= {401, 429, 503}


async def test_addresses_behind_a_trusted_proxy_are_told_apart(run_site: RunSite) -> None:
    async with run_site(log_in=False, trusted_proxies=(HOME,)) as site:
        found = await guess(site.url, HOME, **{"X-Forwarded-For": "192.0.2.66"})
        assert 429 in found
        status, _ = await log_in(site.url, "wrong", **{"X-Forwarded-For": "192.0.2.66, 192.0.2.1"})
        assert status == 401
        # From elsewhere the header is a claim, and counts for nothing.
        claims = (
            log_in(site.url, f"guess {number}", BAD, **{"X-Forwarded-For": f"192.0.2.{number}"})
            for number in range(GUESSES)
        )
        assert 429 in {status for status, _ in await asyncio.gather(*claims)}


async def test_robots_are_counted_by_the_address_they_come_from(run_site: RunSite) -> None:
    """One robot endpoint carries the logins of all; wrong ones of one address hold up no other's."""
    async with run_site(log_in=False) as site, site.robots() as robots:

        async def try_one(robot: str, password: str, address: str) -> int:
            digest = client_digest(password)
            return (await robots.channel.login("testUser", robot, digest, address)).status

        guesses = asyncio.gather(
            *(try_one(f"rob{number}", f"guess {number}", "192.0.2.66") for number in range(GUESSES))
        )
        assert await try_one("rob", RIGHT, "192.0.2.1") == 200
        assert set(await guesses) == {401, 429}
