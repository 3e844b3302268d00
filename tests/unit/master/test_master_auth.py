from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Literal

import pytest
from argon2 import PasswordHasher
from support.master_world import World

from rce_master.auth import MAX_FAILURES, Authenticator, client_digest
from rce_master.exceptions import TooManyFailures, WrongCredentials
from rce_master.state import commands
from rce_master.state.records import User, UserRole

RIGHT, WRONG = client_digest("right"), client_digest("wrong")


class CountingHasher(PasswordHasher):
    def __init__(self) -> None:
        super().__init__(time_cost=1, memory_cost=8, parallelism=1)
        self.verified = 0

    def verify(self, hash: str | bytes, password: str | bytes) -> Literal[True]:  # noqa: A002
        self.verified += 1
        return super().verify(hash, password)


class Gate:
    def __init__(self) -> None:
        self.world = World()
        self.hasher = CountingHasher()
        self.now = 0.0
        user = User(name="zoe", role=UserRole.USER, password=self.hasher.hash(RIGHT), created=0.0)
        self.world.do(commands.AddUser(user=user))
        self.auth = Authenticator(self.world.state.tables, hasher=self.hasher, clock=lambda: self.now)


@pytest.fixture
def gate() -> Iterator[Gate]:
    made = Gate()
    yield made
    made.auth.close()


async def test_right_and_wrong_passwords(gate: Gate) -> None:
    assert (await gate.auth.verify("zoe", RIGHT)).name == "zoe"
    for name, password in (("zoe", WRONG), ("nobody", RIGHT), ("anna", RIGHT)):
        with pytest.raises(WrongCredentials, match="unknown user or wrong password"):
            await gate.auth.verify(name, password)


async def test_a_storm_of_reconnects_costs_one_hash(gate: Gate) -> None:
    gate.auth._slots = asyncio.Semaphore(1)
    await asyncio.gather(*(gate.auth.verify("zoe", RIGHT) for _ in range(200)))
    assert gate.hasher.verified == 1


async def test_an_unknown_user_takes_a_hash_too(gate: Gate) -> None:
    with pytest.raises(WrongCredentials):
        await gate.auth.verify("nobody", RIGHT)
    assert gate.hasher.verified == 1


async def test_too_many_failures_lock_out_guesses_but_not_who_is_known(gate: Gate) -> None:
    await gate.auth.verify("zoe", RIGHT)
    for _ in range(MAX_FAILURES):
        with pytest.raises(WrongCredentials):
            await gate.auth.verify("zoe", WRONG)
    verified = gate.hasher.verified
    with pytest.raises(TooManyFailures, match="try again in 60 s"):
        await gate.auth.verify("zoe", client_digest("another guess"))
    assert gate.hasher.verified == verified
    await gate.auth.verify("zoe", RIGHT)
    gate.now = 61.0
    with pytest.raises(WrongCredentials):
        await gate.auth.verify("zoe", WRONG)


async def test_a_changed_password_makes_the_old_one_worthless(gate: Gate) -> None:
    await gate.auth.verify("zoe", RIGHT)
    new = await gate.auth.hash(client_digest("new"))
    gate.world.do(commands.SetPassword(name="zoe", password=new))
    with pytest.raises(WrongCredentials):
        await gate.auth.verify("zoe", RIGHT)
    await gate.auth.verify("zoe", client_digest("new"))
