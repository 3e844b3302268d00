"""Users take turns in an event loop."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rce.guard.loop_share import LoopShare

if TYPE_CHECKING:
    from collections.abc import Callable


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Load:
    """Parts of work that take a millisecond each; each is noted."""

    def __init__(self, clock: Clock, parts: int, note: Callable[[], None]) -> None:
        self.left = parts
        self._clock = clock
        self._note = note

    def continue_work(self) -> bool:
        self._clock.now += 0.001
        self._note()
        self.left -= 1
        return self.left > 0


async def turns(*loads: tuple[str, int]) -> list[str]:
    """Return who did a part, in order."""
    clock = Clock()
    share = LoopShare(slice_s=0.002, clock=clock)
    done: list[str] = []
    made = [(user, Load(clock, parts, lambda user=user: done.append(user))) for user, parts in loads]  # type: ignore[misc]  # lambda
    for user, load in made:
        share.run(user, load)
    while any(load.left for _, load in made):
        await asyncio.sleep(0)
    return done


async def test_little_is_done_at_once() -> None:
    clock = Clock()
    share = LoopShare(slice_s=0.002, clock=clock)
    assert share.run("a", Load(clock, 1, lambda: None))


async def test_users_who_left_are_not_kept() -> None:
    clock = Clock()
    share = LoopShare(slice_s=0.002, clock=clock)
    for number in range(1000):
        share.run(f"user{number}", Load(clock, 1, lambda: None))
    clock.now += 1.0
    for _ in range(1000):
        share.run("a", Load(clock, 1, lambda: None))
        clock.now += 0.01
    assert len(share._used) < 10


async def test_who_has_much_to_do_waits_for_the_others() -> None:
    assert await turns(("a", 8), ("b", 1), ("c", 3)) == [*"aa", "b", *"cc", *"aa", "c", *"aa", *"aa"]


async def test_many_workloads_of_one_user_have_the_turns_of_one() -> None:
    done = await turns(*(("many", 6) for _ in range(5)), ("one", 6))
    assert done.index("one") == 2
    assert [who for who in done[:16] if who == "one"] == ["one"] * 6


async def test_a_loop_turn_gives_two_slices_at_most() -> None:
    clock = Clock()
    share = LoopShare(slice_s=0.002, clock=clock)
    done: list[str] = []
    for number in range(10):
        share.run(f"user{number}", Load(clock, 100, lambda: done.append("x")))
    done.clear()
    await asyncio.sleep(0)
    assert 0 < len(done) <= 5


async def test_a_workload_that_is_forgotten_gets_no_turn() -> None:
    clock = Clock()
    share = LoopShare(slice_s=0.002, clock=clock)
    load = Load(clock, 10, lambda: None)
    assert not share.run("a", load)
    share.forget("a", load)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert load.left == 8
