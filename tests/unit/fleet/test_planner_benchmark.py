"""The benchmark of the planner, with a few robots."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest

from benchmarks import fleet
from benchmarks.fleet import _warm_up, byte_rates, joined, plan_cost, pose_cost
from rce_fleet.coordination.replanning import PlanRequest


def test_robots_of_the_benchmark_drive() -> None:
    row = pose_cost(4, batches=1)
    assert row["driving, us per pose"] > 0


@pytest.mark.slow
async def test_a_plan_is_made_beside_the_event_loop() -> None:
    row = await plan_cost(4)
    assert row["longest step ms"] > 0


class CompilingWorker:
    """A plan worker whose compiled loops take a while.

    Attributes:
        asked: For each plan, whether the loops were there.
    """

    def __init__(self) -> None:
        self.is_compiled = False
        self.asked: list[bool] = []

    async def compute(self, request: PlanRequest) -> object:
        self.asked.append(self.is_compiled)
        asyncio.get_running_loop().call_later(0.05, setattr, self, "is_compiled", True)
        return request.number


async def test_plans_are_timed_with_compiled_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet, "is_available", lambda: True)
    worker = CompilingWorker()
    await _warm_up(cast("Any", worker), joined(20).requests.pop())
    assert worker.asked == [False, True]


async def test_traffic_of_driving_robots_is_counted() -> None:
    row = await byte_rates(4, seconds=2)
    assert 0 < row["planner, changes, kB/s"] < row["planner, whole, kB/s"]
    assert 0 < row["page, changes, kB/s"] < row["page, whole, kB/s"]
