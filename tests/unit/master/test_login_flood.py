"""Many logins at once hold nobody up who is known, and others by one check at most."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from typing import Literal

import pytest
from argon2 import PasswordHasher
from support.master_world import World

from rce_master.auth import HASH_WORKERS, MAX_WAITING, Authenticator, client_digest
from rce_master.exceptions import TooManyFailuresError, TooManyLoginsError, WrongCredentialsError
from rce_master.state import commands
from rce_master.state.user_records import User, UserRole
from rce_master.throttle import FREE, MAX_ADDRESS_DELAY_S

RIGHT = client_digest("right")
CROWDS = 4


class HeldHasher(PasswordHasher):
    """Checks nothing until it is let go."""

    def __init__(self) -> None:
        super().__init__(time_cost=1, memory_cost=8, parallelism=1)
        self.go = threading.Event()
        self.go.set()
        self.verified: list[str] = []

    def verify(self, hash: str | bytes, password: str | bytes) -> Literal[True]:  # noqa: A002
        self.verified.append(str(password))
        assert self.go.wait(60)
        return super().verify(hash, password)


async def settle() -> None:
    """Let everything happen that waits for no worker thread."""
    for _ in range(10):
        await asyncio.sleep(0)


class Door:
    def __init__(self) -> None:
        self.hasher = HeldHasher()
        self.world = world = World()
        for name in ("zoe", "yan"):
            user = User(name=name, role=UserRole.USER, password=self.hasher.hash(RIGHT), created=0.0)
            world.do(commands.AddUser(user=user))
        self.auth = Authenticator(world.state.tables, hasher=self.hasher)
        self.outcomes: list[type] = []
        self.sent = 0

    async def log_in(self, name: str, digest: str, address: str) -> None:
        try:
            await self.auth.verify(name, digest, address)
        except (WrongCredentialsError, TooManyFailuresError, TooManyLoginsError) as error:
            self.outcomes.append(type(error))

    async def flood(self, group: asyncio.TaskGroup, count: int, address: str) -> None:
        for _ in range(count):
            self.sent += 1
            guess = client_digest(f"guess {self.sent}")
            group.create_task(self.log_in(f"nobody{self.sent}", guess, address))
        await settle()


@pytest.fixture
async def door() -> AsyncIterator[Door]:
    made = Door()
    yield made
    made.hasher.go.set()
    made.auth.close()


async def test_flood_delays_other_address_by_own_checks_only(door: Door) -> None:
    """A known client comes in without a turn; an unknown one has the next turn, though the queue is full."""
    await door.auth.verify("zoe", RIGHT, "home")
    door.hasher.go.clear()
    async with asyncio.TaskGroup() as group:
        await door.flood(group, HASH_WORKERS + MAX_WAITING, "bad")
        assert (await door.auth.verify("zoe", RIGHT, "home")).name == "zoe"
        await door.flood(group, 5, "bad")
        assert door.outcomes == [TooManyLoginsError] * 5
        stranger = group.create_task(door.auth.verify("yan", RIGHT, "elsewhere"))
        await settle()
        assert not stranger.done()
        door.hasher.go.set()
    assert stranger.result().name == "yan"
    # After those that were begun before and at most one from the flood.
    assert door.hasher.verified.index(RIGHT, 1) <= 1 + HASH_WORKERS + 1


async def test_many_addresses_share_what_there_is(door: Door) -> None:
    door.hasher.go.clear()
    async with asyncio.TaskGroup() as group:
        for number in range(CROWDS):
            await door.flood(group, MAX_WAITING, f"bad{number}")
        begun = len(door.hasher.verified)
        stranger = group.create_task(door.auth.verify("yan", RIGHT, "elsewhere"))
        await settle()
        door.hasher.go.set()
    assert stranger.result().name == "yan"
    assert door.hasher.verified.index(RIGHT) <= begun + CROWDS + HASH_WORKERS


async def test_wrong_passwords_checked_together_are_counted(
    door: Door, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that are still being checked are counted, too; the others draw no turn before they must go."""
    monkeypatch.setattr("rce_master.auth.MAX_DELAY_S", 0.01)
    door.hasher.go.clear()
    async with asyncio.TaskGroup() as group:
        for number in range(20):
            group.create_task(door.log_in("zoe", client_digest(str(number)), "bad"))
        async with asyncio.timeout(60):
            while len(door.outcomes) < 20 - FREE:
                await asyncio.sleep(0.01)
        assert door.outcomes == [TooManyFailuresError] * (20 - FREE)
        door.hasher.go.set()
    assert door.outcomes.count(WrongCredentialsError) == FREE


@pytest.mark.slow
@pytest.mark.parametrize("names", ["unknown", "zoe"])
async def test_flood_delays_first_login_by_few_checks(door: Door, names: str) -> None:
    """A fleet and its attacker behind one router: the queue is full of guesses, and of nothing else."""
    door.hasher.go.clear()
    async with asyncio.TaskGroup() as group:
        for number in range(4 * MAX_WAITING):
            name = names if names == "zoe" else f"nobody{number}"
            group.create_task(door.log_in(name, client_digest(f"guess {number}"), "router"))
        await settle()
        first = group.create_task(door.auth.verify("yan", RIGHT, "router"))
        await asyncio.sleep(MAX_ADDRESS_DELAY_S)
        assert not first.done()
        door.hasher.go.set()
    assert first.result().name == "yan"
    # After those that were begun before, and two of the others.
    assert door.hasher.verified.index(RIGHT) <= HASH_WORKERS + 2


async def test_password_that_was_just_set_is_known(door: Door) -> None:
    hashed = await door.auth.hash(RIGHT)
    door.world.do(commands.SetPassword(name="zoe", password=hashed))
    await door.auth.know("zoe", hashed, RIGHT)
    assert (await door.auth.verify("zoe", RIGHT, "router")).name == "zoe"
    assert door.hasher.verified == []
