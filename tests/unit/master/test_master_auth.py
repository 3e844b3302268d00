from __future__ import annotations

import asyncio
import contextlib
import itertools
import random
from collections.abc import Iterator
from typing import Literal

import pytest
from argon2 import PasswordHasher, extract_parameters
from argon2.exceptions import VerifyMismatchError
from support.master_world import World

from rce_master.auth import Authenticator, client_digest, hash_public
from rce_master.exceptions import TooManyFailuresError, WrongCredentialsError
from rce_master.state import commands
from rce_master.state.tables import Tables
from rce_master.state.user_records import KnownLogin, User, UserRole
from rce_master.throttle import FREE, PACE_S

KEY = b"a key"
RIGHT, WRONG = client_digest("right"), client_digest("wrong")


class CountingHasher(PasswordHasher):
    def __init__(self) -> None:
        super().__init__(time_cost=1, memory_cost=8, parallelism=1)
        self.verified = 0

    def verify(self, hash: str | bytes, password: str | bytes) -> Literal[True]:  # noqa: A002
        self.verified += 1
        return super().verify(hash, password)


class Gate:
    def __init__(self, tables: Tables | None = None, hasher: CountingHasher | None = None) -> None:
        self.world = World()
        self.hasher = hasher or CountingHasher()
        self.now = 0.0
        self.keys = [KEY]
        self.password = self.hasher.hash(RIGHT)
        user = User(name="zoe", role=UserRole.USER, password=self.password, created=0.0)
        self.world.do(commands.AddUser(user=user))
        self.auth = Authenticator(
            tables or self.world.state.tables,
            hasher=self.hasher,
            clock=lambda: self.now,
            keys=lambda: self.keys,
        )


@pytest.fixture
def gate() -> Iterator[Gate]:
    made = Gate()
    yield made
    made.auth.close()


async def test_right_and_wrong_passwords(gate: Gate) -> None:
    assert (await gate.auth.verify("zoe", RIGHT)).name == "zoe"
    for name, password in (("zoe", WRONG), ("nobody", RIGHT), ("anna", RIGHT)):
        with pytest.raises(WrongCredentialsError, match="unknown user or wrong password"):
            await gate.auth.verify(name, password)


async def test_a_public_password_costs_little_to_check() -> None:
    """By the hasher of all passwords, which a wrong one does not pass either."""
    world = World()
    hashed = hash_public(RIGHT)
    world.do(commands.AddUser(user=User(name="zoe", role=UserRole.USER, password=hashed, created=0.0)))
    auth = Authenticator(world.state.tables)
    assert (await auth.verify("zoe", RIGHT)).name == "zoe"
    with pytest.raises(WrongCredentialsError):
        await auth.verify("zoe", WRONG)
    auth.close()
    costs, usual = extract_parameters(hashed), extract_parameters(PasswordHasher().hash(RIGHT))
    assert (costs.time_cost, costs.type) == (1, usual.type)
    assert costs.memory_cost * 1000 < usual.memory_cost


async def test_a_storm_of_reconnects_costs_one_hash(gate: Gate) -> None:
    await asyncio.gather(*(gate.auth.verify("zoe", RIGHT, "192.0.2.1") for _ in range(200)))
    assert gate.hasher.verified == 1


async def test_a_login_that_is_given_up_takes_no_other_with_it(gate: Gate) -> None:
    first, second = (asyncio.create_task(gate.auth.verify("zoe", RIGHT)) for _ in range(2))
    await asyncio.sleep(0)
    first.cancel()
    assert (await second).name == "zoe"
    assert gate.hasher.verified == 1


async def test_the_hash_of_an_unknown_user_costs_what_another_does(gate: Gate) -> None:
    """It is not computed: a master that takes over must not be held up."""
    made = gate.auth._unknown_user
    assert extract_parameters(made) == extract_parameters(gate.password)
    with pytest.raises(VerifyMismatchError):
        gate.hasher.verify(made, RIGHT)


async def test_an_unknown_user_takes_a_hash_too(gate: Gate) -> None:
    with pytest.raises(WrongCredentialsError):
        await gate.auth.verify("nobody", RIGHT)
    assert gate.hasher.verified == 1


async def guess(gate: Gate, count: int, address: str = "192.0.2.66") -> None:
    for number in range(count):
        with pytest.raises(WrongCredentialsError):
            await gate.auth.verify("zoe", client_digest(f"guess {number}"), address)


async def test_guesses_from_one_address_hold_up_nobody_else(gate: Gate) -> None:
    """A password that is right gets in from elsewhere at once, though no check of it was ever made."""
    await guess(gate, FREE)
    delayed = asyncio.create_task(gate.auth.verify("zoe", client_digest("eleventh"), "192.0.2.66"))
    await asyncio.sleep(0)
    assert gate.hasher.verified == FREE
    assert (await gate.auth.verify("zoe", RIGHT, "192.0.2.1")).name == "zoe"
    assert (await gate.auth.verify("zoe", RIGHT, "192.0.2.66")).name == "zoe"
    assert not delayed.done()
    delayed.cancel()


async def test_right_password_gets_a_turn_beside_guesses(gate: Gate, monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind one address with an attacker whose guesses wait all the time, more than there are turns."""
    gate.auth._lottery._dice = random.Random(1)
    numbers = itertools.count()
    go = asyncio.Event()

    async def breathe() -> None:
        await asyncio.get_running_loop().run_in_executor(None, lambda: None)

    async def sleep(seconds: float) -> None:
        await go.wait()
        await breathe()
        gate.now += seconds

    async def guess_again_and_again() -> None:
        while True:
            with contextlib.suppress(WrongCredentialsError, TooManyFailuresError):
                await gate.auth.verify("zoe", client_digest(f"guess {next(numbers)}"), "192.0.2.66")
            await breathe()

    monkeypatch.setattr("rce_master.auth.asyncio.sleep", sleep)
    monkeypatch.setattr("rce_master.auth.MAX_DELAY_S", 600.0)
    attackers = [asyncio.create_task(guess_again_and_again()) for _ in range(5)]
    try:
        while not gate.auth._throttle.delayed:
            await breathe()
        right = asyncio.create_task(gate.auth.verify("zoe", RIGHT, "192.0.2.66"))
        await breathe()
        assert not right.done()
        go.set()
        assert (await right).name == "zoe"
        assert gate.hasher.verified <= FREE + 1 + gate.now / PACE_S
    finally:
        for attacker in attackers:
            attacker.cancel()
        await asyncio.wait(attackers)


async def test_a_login_that_draws_no_turn_is_told_to_try_again(
    gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All that sent this password, at once: their check has waited as long as it may."""
    monkeypatch.setattr("rce_master.auth.MAX_DELAY_S", 0.01)
    await guess(gate, FREE)
    logins = (gate.auth.verify("zoe", RIGHT, "192.0.2.66") for _ in range(3))
    for error in await asyncio.gather(*logins, return_exceptions=True):
        assert isinstance(error, TooManyFailuresError)
        assert "from your address; try again in 1 s" in str(error)
    assert gate.hasher.verified == FREE


async def test_a_right_password_is_known_over_a_restart(gate: Gate) -> None:
    """Guesses come first after the restart, from the fleet's own address; the fleet gets in at once."""
    kept = []

    async def remember(login: KnownLogin) -> None:
        kept.append(login)
        gate.world.do(commands.RememberLogin(login=login))

    tables = gate.world.state.tables
    gate.auth._remember = remember
    await gate.auth.verify("zoe", RIGHT)
    assert [login.user for login in kept] == ["zoe"]
    assert RIGHT not in kept[0].mark
    restarted = Gate(tables, gate.hasher)
    try:
        await guess(restarted, FREE)
        before = gate.hasher.verified
        assert (await restarted.auth.verify("zoe", RIGHT, "192.0.2.66")).name == "zoe"
        assert gate.hasher.verified == before
        new = await restarted.auth.hash(client_digest("new"))
        gate.world.do(commands.SetPassword(name="zoe", password=new))
        assert len(tables.known_logins) == 0
        with pytest.raises(WrongCredentialsError):
            await restarted.auth.verify("zoe", RIGHT, "192.0.2.1")
    finally:
        restarted.auth.close()


async def test_marks_made_with_another_key_are_worth_nothing(gate: Gate) -> None:
    (mark,) = gate.auth._marks("zoe", gate.password, WRONG)
    forged = KnownLogin(user="zoe", mark=mark)
    gate.keys = [b"another key"]
    gate.world.do(commands.RememberLogin(login=forged))
    with pytest.raises(WrongCredentialsError):
        await gate.auth.verify("zoe", WRONG)


async def test_password_is_known_over_rotated_secrets(gate: Gate) -> None:
    """Its mark is renewed while the former secret is accepted, and holds when that is retired."""

    async def remember(login: KnownLogin) -> None:
        gate.world.do(commands.RememberLogin(login=login))

    tables = gate.world.state.tables
    gate.auth._remember = remember
    await gate.auth.verify("zoe", RIGHT)
    for keys in ([b"new", KEY], [b"new"]):
        restarted = Gate(tables, gate.hasher)
        restarted.keys = keys
        restarted.auth._remember = remember
        try:
            before = gate.hasher.verified
            assert (await restarted.auth.verify("zoe", RIGHT)).name == "zoe"
            assert gate.hasher.verified == before
        finally:
            restarted.auth.close()


async def test_mark_is_stored_later_if_the_store_failed(gate: Gate) -> None:
    kept: list[KnownLogin] = []

    async def remember(login: KnownLogin) -> None:
        if gate.now == 0.0:
            raise OSError("the disk is full")
        kept.append(login)

    gate.auth._remember = remember
    with pytest.raises(OSError, match="full"):
        await gate.auth.verify("zoe", RIGHT)
    gate.now = 1.0
    await gate.auth.verify("zoe", RIGHT)
    assert [login.user for login in kept] == ["zoe"]


async def test_a_changed_password_makes_the_old_one_worthless(gate: Gate) -> None:
    await gate.auth.verify("zoe", RIGHT)
    new = await gate.auth.hash(client_digest("new"))
    gate.world.do(commands.SetPassword(name="zoe", password=new))
    with pytest.raises(WrongCredentialsError):
        await gate.auth.verify("zoe", RIGHT)
    await gate.auth.verify("zoe", client_digest("new"))
