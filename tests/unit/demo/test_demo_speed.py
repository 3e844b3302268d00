"""How fast the simulated world runs: measured, and told when it changes."""

from __future__ import annotations

import asyncio

import pytest
from support.fleet_states import truth

from rce.aio.tasks import cancel_and_wait
from rce_fleet.demo import speed as module
from rce_fleet.demo.speed import WorldSpeed, tell_speed
from rce_fleet.drivers.report import WorldReport

WORLD = truth({})


def at(seconds: float) -> WorldReport:
    return WORLD.model_copy(update={"time_s": seconds})


class Machine:
    """Half a minute passes with each look at the world, which runs at these factors."""

    def __init__(self, *factors: float) -> None:
        self.factors = [factor for factor in factors for _ in range(2)]
        self.now = self.simulated = 0.0
        self.is_done = asyncio.Event()

    def look(self) -> WorldReport | None:
        if not self.factors:
            self.is_done.set()
            return None
        self.now += 30.0
        self.simulated += 30.0 * self.factors.pop(0)
        return at(self.simulated)


def test_speed_is_that_since_the_first_look_or_a_reset() -> None:
    speed = WorldSpeed()
    assert speed.factor == 0.0
    for now, simulated, factor in ((10, 5, 0), (20, 13, 0.8), (30, 15, 0.5), (40, 1, 0), (50, 11, 1.0)):
        speed.look(at(simulated), now)
        assert speed.factor == factor


async def test_speed_is_told_when_it_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "TELL_EVERY_S", 0.0)
    machine, said = Machine(0.8, 0.8, 0.85, 0.5, 1.0, 1.0), list[str]()
    telling = asyncio.create_task(tell_speed(machine.look, said.append, lambda: machine.now))
    async with asyncio.timeout(60):
        await machine.is_done.wait()
    await cancel_and_wait(telling)
    assert said == [f"real-time factor {factor}" for factor in ("0.80", "0.50", "1.00")]
