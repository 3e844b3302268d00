"""Turns that are drawn by lot, at a clock that the test moves on."""

from __future__ import annotations

import asyncio
import random
from collections import Counter

import pytest

from rce.guard import Rates
from rce_master.lottery import Lottery

PACE_S = 3.0


class Clock:
    """Goes on only while the lottery sleeps."""

    def __init__(self) -> None:
        self.now = 0.0

    async def sleep(self, seconds: float) -> None:
        self.now += seconds
        await asyncio.get_running_loop().run_in_executor(None, lambda: None)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr("rce_master.lottery.asyncio.sleep", made.sleep)
    return made


def made(clock: Clock, seed: int = 1) -> Lottery:
    rates = Rates(per_second=1 / PACE_S, burst=1)
    return Lottery(lambda key: rates.take(key, clock.now), random.Random(seed))


async def test_a_turn_is_taken_at_once_where_none_waits() -> None:
    left = 1

    def take(_: str) -> float:
        nonlocal left
        left -= 1
        return 0.0 if left >= 0 else 60.0

    turns = Lottery(take)
    assert (turns.take("a"), turns.take("a")) == (True, False)
    waiting = asyncio.create_task(turns.draw("a", lambda: 1, 60))
    for _ in range(3):
        await asyncio.sleep(0)
    left = 1
    assert not turns.take("a"), "another one waits for it"
    waiting.cancel()
    await asyncio.wait([waiting])
    assert turns.take("a")


async def test_turns_come_one_after_the_other(clock: Clock) -> None:
    turns = made(clock)
    drawn = await asyncio.gather(*(turns.draw("a", lambda: 1, 60) for _ in range(5)))
    assert drawn == [True] * 5
    assert clock.now == pytest.approx(4 * PACE_S)


async def test_many_tickets_are_drawn_more_often(clock: Clock) -> None:
    """Each first draw is between one with nine tickets and one with a single one."""
    first: Counter[str] = Counter()
    for seed in range(100):
        turns = made(clock, seed)
        order: list[str] = []

        async def wait(name: str, tickets: int, turns: Lottery = turns, order: list[str] = order) -> None:
            assert await turns.draw("a", lambda: tickets, 60)
            order.append(name)

        assert turns.take("a")
        await asyncio.gather(wait("one", 1), wait("nine", 9))
        first[order[0]] += 1
    assert 80 <= first["nine"] < 100


async def test_one_without_a_turn_is_told_after_its_wait() -> None:
    """And takes none of the turns that come later."""
    free: list[float] = [60.0]
    turns = Lottery(lambda _: free[0])
    assert not await turns.draw("a", lambda: 1, 0.01)
    free[0] = 0.0
    assert turns.take("a")


async def test_a_cancelled_wait_leaves_nothing() -> None:
    turns = Lottery(lambda _: 60.0)
    waits = [asyncio.create_task(turns.draw("a", lambda: 1, 60)) for _ in range(2)]
    await asyncio.sleep(0)
    for wait in waits:
        wait.cancel()
    await asyncio.wait(waits)
    assert (turns._waiting, turns._givers) == ({}, {})
