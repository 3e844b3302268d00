"""The benchmark of the planner, with a few robots."""

from __future__ import annotations

from benchmarks.fleet import byte_rates, plan_cost, pose_cost


def test_robots_of_the_benchmark_drive() -> None:
    row = pose_cost(4, batches=1)
    assert row["driving, us per pose"] > 0


async def test_a_plan_is_made_beside_the_event_loop() -> None:
    row = await plan_cost(4)
    assert row["longest step ms"] > 0


async def test_traffic_of_driving_robots_is_counted() -> None:
    row = await byte_rates(4, seconds=2)
    assert 0 < row["planner, changes, kB/s"] < row["planner, whole, kB/s"]
    assert 0 < row["page, changes, kB/s"] < row["page, whole, kB/s"]
