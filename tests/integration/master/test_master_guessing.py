"""Strangers who guess passwords, over real sockets."""

from __future__ import annotations

import asyncio
import itertools
import signal
from typing import TYPE_CHECKING

import aiohttp
import pytest
from argon2 import PasswordHasher
from support.master_program import master

from rce_master.auth import client_digest
from rce_master.state.commands import AddUser
from rce_master.state.user_records import User, UserRole
from rce_master.throttle import FREE, FREE_OF_ADDRESS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from integration.master.conftest import RunSite


GUESSES = 40
HASHER = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)
RIGHT = "testUser"
HOME, BAD, ELSEWHERE = "127.0.0.1", "127.0.0.66", "127.0.0.7"


@pytest.fixture
def short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """A login waits for its turn for a shorter time than there is between two."""
    monkeypatch.setattr("rce_master.auth.MAX_DELAY_S", 0.3)


async def log_in(
    url: str, password: str, address: str = HOME, user: str = "testUser", **headers: str
) -> tuple[int, str | None]:
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


@pytest.mark.usefixtures("short_waits")
async def test_guesses_from_one_address_hold_up_no_other(run_site: RunSite) -> None:
    """The master starts with no memory of any password."""
    async with run_site(log_in=False) as site:
        bad = asyncio.gather(*(guess(site.url, BAD) for _ in range(5)))
        assert (await log_in(site.url, RIGHT, ELSEWHERE))[0] == 200
        assert {status for found in await bad for status in found} <= {401, 429, 503}


@pytest.mark.usefixtures("short_waits")
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


@pytest.mark.usefixtures("short_waits")
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


async def attack(url: str, names: Iterator[str], connections: int) -> None:
    """Guess with some connections from HOME until cancelled."""

    async def go_on(number: int) -> None:
        for name in names:
            await log_in(url, f"guess {number}", HOME, name)

    await asyncio.gather(*(go_on(number) for number in range(connections)))


async def password_checks(url: str) -> float:
    async with aiohttp.ClientSession() as session, session.get(f"{url}metrics") as reply:
        lines = (await reply.text()).splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith("rce_password_checks_total")))


@pytest.mark.parametrize("names", ["one user's", "inventions"])
async def test_first_login_beside_an_attacker_at_the_same_address(run_site: RunSite, names: str) -> None:
    """A user whose password the master has never seen waits for few checks, however many are tried."""
    inventions = (f"nobody{number}" for number in itertools.count())
    guessed = itertools.repeat("victim") if names == "one user's" else inventions
    async with run_site(log_in=False) as site:
        victim = User(name="victim", role=UserRole.USER, password=HASHER.hash("secret"), created=0.0)
        await site.master.state_service.submit(AddUser(user=victim))
        attackers = asyncio.create_task(attack(site.url, guessed, 20))
        try:
            while await password_checks(site.url) < (FREE if names == "one user's" else FREE_OF_ADDRESS):
                await asyncio.sleep(0.05)
            before = await password_checks(site.url)
            assert (await log_in(site.url, RIGHT, HOME))[0] == 200
            assert not attackers.done()
            assert await password_checks(site.url) - before <= 80
        finally:
            attackers.cancel()
            await asyncio.wait([attackers])
