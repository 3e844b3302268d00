from __future__ import annotations

import asyncio
import random

import pytest

from rce.guard.turns import CrowdedError, Turns


class Site:
    """Work at turns that ends when it is told to."""

    def __init__(self, turns: Turns, group: asyncio.TaskGroup) -> None:
        self.turns = turns
        self.group = group
        self.begun: list[str] = []
        self.refused: list[str] = []
        self.ends: dict[str, asyncio.Event] = {}

    async def ask(self, name: str, crowd: str, member: str = "") -> asyncio.Task[None]:
        self.ends[name] = asyncio.Event()
        task = self.group.create_task(self._work(name, crowd, member))
        await asyncio.sleep(0)
        return task

    async def _work(self, name: str, crowd: str, member: str) -> None:
        try:
            async with self.turns.turn(crowd, member):
                self.begun.append(name)
                await self.ends[name].wait()
        except CrowdedError:
            self.refused.append(name)

    async def end_all(self) -> None:
        """End work in the order in which it began, until nobody works or waits."""
        ended = 0
        while self.turns.working:
            self.ends[self.begun[ended]].set()
            ended += 1
            for _ in range(4):
                await asyncio.sleep(0)


async def test_crowds_take_turns_however_much_one_asks_for() -> None:
    async with asyncio.TaskGroup() as group:
        site = Site(Turns(1, waiting=100), group)
        for number in range(5):
            await site.ask(f"a{number}", "a")
        await site.ask("b0", "b")
        await site.ask("b1", "b")
        await site.ask("c0", "c")
        await site.end_all()
    assert site.begun == ["a0", "a1", "b0", "c0", "a2", "b1", "a3", "a4"]


async def test_members_of_a_crowd_take_turns() -> None:
    async with asyncio.TaskGroup() as group:
        site = Site(Turns(1, waiting=100), group)
        for number in range(4):
            await site.ask(f"x{number}", "proxy", "x")
        await site.ask("y0", "proxy", "y")
        await site.end_all()
    assert site.begun == ["x0", "x1", "y0", "x2", "x3"]


async def test_when_too_many_wait_the_largest_crowd_makes_room() -> None:
    async with asyncio.TaskGroup() as group:
        site = Site(Turns(1, waiting=3), group)
        for number in range(5):
            await site.ask(f"a{number}", "a")
        assert site.refused == ["a4"]
        await site.ask("b0", "b")
        await asyncio.sleep(0)
        assert site.refused == ["a4", "a3"]
        await site.end_all()
    assert site.begun == ["a0", "a1", "b0", "a2"]


async def test_member_with_most_makes_room_within_its_crowd() -> None:
    """A client that shares an address with a flood finds room in a full queue."""
    async with asyncio.TaskGroup() as group:
        site = Site(Turns(1, waiting=3), group)
        for number in range(5):
            await site.ask(f"x{number}", "router", "x")
        assert site.refused == ["x4"]
        await site.ask("y0", "router", "y")
        await asyncio.sleep(0)
        assert site.refused == ["x4", "x3"]
        await site.ask("x5", "router", "x")
        assert site.refused == ["x4", "x3", "x5"]
        await site.end_all()
    assert site.begun == ["x0", "x1", "y0", "x2"]


async def test_a_waiter_that_was_just_cancelled_makes_room() -> None:
    turns, end = Turns(1, waiting=1), asyncio.Event()

    async def work() -> None:
        async with turns.turn("a"):
            await end.wait()

    working, waiting = asyncio.create_task(work()), asyncio.create_task(work())
    await asyncio.sleep(0)
    waiting.cancel()
    end.set()
    async with turns.turn("b"):
        assert working.done()
    await asyncio.gather(working, waiting, return_exceptions=True)
    assert waiting.cancelled()
    assert (turns.working, turns.waiting) == (0, 0)


async def test_a_crowd_has_no_more_at_work_than_it_may() -> None:
    async with asyncio.TaskGroup() as group:
        site = Site(Turns(3, waiting=100, each=1), group)
        for number in range(3):
            await site.ask(f"a{number}", "a")
        await site.ask("b0", "b")
        assert site.begun == ["a0", "b0"]
        site.ends["a0"].set()
        for _ in range(4):
            await asyncio.sleep(0)
        assert site.begun == ["a0", "b0", "a1"]
        await site.end_all()
    assert site.begun == ["a0", "b0", "a1", "a2"]


@pytest.mark.parametrize("seed", range(20))
async def test_nothing_is_lost_however_askers_come_and_go(seed: int) -> None:
    """Asking, cancelling and ending in any order leaves no turn taken and nobody waiting."""
    chance = random.Random(seed)
    turns = Turns(chance.randint(1, 3), waiting=6, each=chance.randint(0, 2))
    async with asyncio.TaskGroup() as group:
        site = Site(turns, group)
        tasks = []
        for number in range(60):
            crowd, member = chance.choice("abc"), chance.choice("xy")
            tasks.append(await site.ask(f"{number}", crowd, member))
            if chance.random() < 0.3:
                chance.choice(tasks).cancel()
            if chance.random() < 0.4 and site.begun:
                site.ends[chance.choice(site.begun)].set()
            await asyncio.sleep(0)
            assert turns.working <= turns._at_once
            assert turns.waiting <= 6
        for event in site.ends.values():
            event.set()
    assert (turns.working, turns.waiting) == (0, 0)
