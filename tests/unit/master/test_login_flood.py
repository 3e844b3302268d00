"""Many logins at once hold nobody up who is known."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest
from argon2 import PasswordHasher
from support.master_world import World

from rce_master.auth import HASH_WORKERS, MAX_FAILURES, MAX_WAITING, Authenticator, client_digest
from rce_master.exceptions import TooManyFailures, TooManyLogins, WrongCredentials
from rce_master.state import commands
from rce_master.state.records import User, UserRole

RIGHT = client_digest("right")
HASHER = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)


@pytest.fixture
async def auth() -> AsyncIterator[Authenticator]:
    world = World()
    user = User(name="zoe", role=UserRole.USER, password=HASHER.hash(RIGHT), created=0.0)
    world.do(commands.AddUser(user=user))
    made = Authenticator(world.state.tables, hasher=HASHER)
    yield made
    made.close()


async def held(auth: Authenticator, group: asyncio.TaskGroup, count: int, user: str = "") -> list[object]:
    """Begin logins while no worker thread is free; returns where their results come."""
    results: list[object] = []

    async def log_in(number: int) -> None:
        try:
            results.append(await auth.verify(user or f"nobody{number}", client_digest(str(number))))
        except (WrongCredentials, TooManyFailures) as error:
            results.append(type(error))

    for number in range(count):
        group.create_task(log_in(number))
    await asyncio.sleep(0)
    return results


async def test_what_is_beyond_the_queue_is_refused_at_once_and_known_people_come_in(
    auth: Authenticator,
) -> None:
    await auth.verify("zoe", RIGHT)
    for _ in range(HASH_WORKERS):
        await auth._slots.acquire()
    async with asyncio.TaskGroup() as group:
        results = await held(auth, group, MAX_WAITING)
        with pytest.raises(TooManyLogins):
            await auth.verify("one_more", RIGHT)
        assert (await auth.verify("zoe", RIGHT)).name == "zoe"
        assert results == []
        for _ in range(HASH_WORKERS):
            auth._slots.release()
    assert results == [WrongCredentials] * MAX_WAITING
    with pytest.raises(WrongCredentials):
        await auth.verify("one_more", RIGHT)


async def test_wrong_passwords_that_waited_together_are_counted_all_the_same(auth: Authenticator) -> None:
    for _ in range(HASH_WORKERS - 1):
        await auth._slots.acquire()
    async with asyncio.TaskGroup() as group:
        results = await held(auth, group, MAX_FAILURES + 5, "zoe")
    assert results.count(WrongCredentials) == MAX_FAILURES
    assert results.count(TooManyFailures) == 5
