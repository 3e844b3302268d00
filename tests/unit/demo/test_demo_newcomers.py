"""Robots that are put into the world of a demo join its fleet, and leave it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress

import pytest
from support.fleet_states import truth

from rce.aio.tasks import cancel_and_wait
from rce_fleet.demo import newcomers
from rce_fleet.demo.exceptions import NotReadyError
from rce_fleet.demo.newcomers import Newcomers
from rce_fleet.drivers.report import WorldReport
from rce_fleet.geometry.poses import Pose


def report(**places: tuple[float, float]) -> WorldReport:
    """A world in which robots stand at places, metres."""
    made = truth(dict.fromkeys(places, 0))
    moved = [each.model_copy(update=dict(zip("xy", places[each.id], strict=True))) for each in made.robots]
    return made.model_copy(update={"robots": moved})


class Demo:
    """A world, and who is of its fleet."""

    def __init__(self) -> None:
        self.world: WorldReport | None = None
        self.looks = 0
        self.fleet: dict[int, Pose] = {}
        self.said: list[str] = []
        self.broken: set[int] = set()

    def truth(self) -> WorldReport | None:
        self.looks += 1
        return self.world

    async def looked(self) -> None:
        """Wait until the world was looked at, and what was seen there has been carried out."""
        seen = self.looks
        await self.until(lambda: self.looks >= seen + 2)

    @asynccontextmanager
    async def join(self, number: int, at: Pose) -> AsyncIterator[None]:
        if number in self.broken:
            raise NotReadyError("robot5 was not ready within 90 s")
        self.fleet[number] = at
        try:
            yield
        finally:
            del self.fleet[number]

    async def until(self, holds: Callable[[], bool]) -> None:
        async with asyncio.timeout(30):
            while not holds():
                await asyncio.sleep(0.005)


@pytest.fixture
async def demo(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Demo]:
    monkeypatch.setattr(newcomers, "LOOK_EVERY_S", 0.001)
    made = Demo()
    following = Newcomers(frozenset({"Robot1"}), made.truth, made.join, made.said.append)
    running = asyncio.create_task(following.run())
    yield made
    await cancel_and_wait(running)
    with suppress(asyncio.CancelledError):
        running.result()
    assert made.fleet == {}


async def test_a_robot_joins_where_it_stands_until_it_is_taken_out(demo: Demo) -> None:
    demo.world = report(Robot1=(0.5, 0.5))
    await demo.looked()
    assert demo.fleet == {}, "the demo has had it from the start"
    demo.world = report(Robot1=(0.5, 0.5), Robot4=(3.5, 2.5))
    await demo.until(lambda: demo.fleet.get(4) == Pose(3.5, 2.5, 0.0))
    demo.world = report(Robot1=(0.5, 0.5), Robot4=(4.5, 2.5))
    await demo.looked()
    assert demo.fleet == {4: Pose(3.5, 2.5, 0.0)}, "it joins once"
    demo.world = report(Robot1=(0.5, 0.5))
    await demo.until(lambda: demo.fleet == {})
    demo.world = report(Robot4=(1.5, 1.5))
    await demo.until(lambda: demo.fleet.get(4) == Pose(1.5, 1.5, 0.0))
    assert demo.said == ["Robot4 joins the fleet"] * 2


async def test_a_robot_that_cannot_join_leaves_the_others(demo: Demo) -> None:
    demo.broken.add(5)
    demo.world = report(Robot5=(1.5, 1.5), cart=(2.5, 2.5), Robot6=(3.5, 3.5))
    await demo.until(lambda: 6 in demo.fleet and len(demo.said) == 3)
    assert "Robot5 stays outside the fleet: robot5 was not ready within 90 s" in demo.said
    assert "cart stays outside the fleet: only robots with names such as Robot7 join it" in demo.said
