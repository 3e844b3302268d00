"""The ways that the planner chooses for a robot follow what its profile says of zones."""

from __future__ import annotations

from dataclasses import replace
from math import nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.fleet_manager import ManagerClient, Planner
from support.planner_copy import RUN, Both

from rce.ros.types import Time
from rce_fleet.coordination.events import (
    CostsSet,
    Event,
    GoalSet,
    MakePlan,
    PlanMade,
    PoseSeen,
    Reply,
    ReportSeen,
    Tick,
    ZonesSet,
)
from rce_fleet.coordination.grid_change import next_planner
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.replanning import compute_plan
from rce_fleet.manager.mirror import REFUSED_S
from rce_fleet.manager.planner_sync import SetCosts
from rce_fleet.manager.zones import zone_fields
from rce_fleet.nodes.fleet_facts import FactKeeper
from rce_fleet.nodes.state_publisher import state_fields
from rce_fleet.nodes.zone_messages import costs_fields, read_costs_set, read_zone
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.records import RobotEntry, RobotProfile, Zone
from rce_fleet.tasks.zone_costs import OwnCosts

GRID = GridMap(3, 5)
STRAIGHT = [5, 6, 7, 8, 9]
RAMP = {"kind": "cost", "value": 1, "cells": [6, 7, 8]}
DEAR = {"ramp": 10.0}
GO = [{"cell": 9}]
DELIVERY = [{"action": "pick", "cell": 5}, {"action": "deliver", "cell": 9}]


class PlannerCore(Planner):
    """The planner without its node, and Robot1, which stands in cell 5 and is driven by nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.core = FleetPlanner(GRID)
        self.now = 0.0

    def handle(self, event: Event) -> str:
        """Let the planner handle an event, and its own plan; return why it refuses."""
        refusal = ""
        for done in self.core.handle(event, self.now):
            if isinstance(done, MakePlan):
                self.handle(PlanMade(compute_plan(done.request)))
            elif isinstance(done, Reply) and not done.ok:
                refusal = done.message
        return refusal

    def pass_time(self) -> None:
        for _ in range(4):
            self.now += 0.5
            self.handle(PoseSeen("Robot1", *GRID.centre(5), 0.0))
            revision = self.core.state.robots["Robot1"].revision
            self.handle(ReportSeen("Robot1", ClientReport(revision, ClientState.IDLE)))
            self.handle(Tick())

    async def set_goal(self, robot: str, cell: int | None) -> str:
        return self.handle(GoalSet(robot, cell))

    async def set_zone(self, name: str, zone: Zone | None, now: float) -> str:
        assert zone is not None
        message: Any = SimpleNamespace(**{"robots": [], **zone_fields(zone, now)})
        return self.handle(ZonesSet((read_zone(message, self.now),)))

    async def set_costs(self, costs: OwnCosts) -> str:
        message: Any = SimpleNamespace(**costs_fields(costs))
        return self.handle(read_costs_set(message))


@pytest.mark.parametrize(
    ("profile", "stops", "is_straight"),
    [
        ({}, GO, True),
        ({"zone_cost": DEAR}, GO, False),
        ({"loaded_zone_cost": DEAR}, GO, True),
        ({"loaded_zone_cost": DEAR}, DELIVERY, False),
        ({"zone_cost": DEAR, "loaded_zone_cost": {"ramp": 1.0}}, DELIVERY, True),
    ],
)
async def test_a_planned_way_follows_the_robots_costs(
    tmp_path: Path, profile: dict[str, Any], stops: list[dict[str, Any]], is_straight: bool
) -> None:
    """For other robots, the zone costs what the floor beside it does."""
    planner = PlannerCore()
    client = ManagerClient(tmp_path / "j.sqlite", planner)
    manager, facts = client.manager, FactKeeper(client.manager.facts)
    facts.take_rotation({"secs": 5, "nsecs": 0}, 0.0)
    plan: tuple[int, ...] = ()
    for turn in range(10):
        planner.pass_time()
        state = {**state_fields(Time(5, 0), planner.core), "started": {"secs": 5, "nsecs": 0}}
        if facts.take_state({"sequence": 0, "state": state}, manager.clock()):
            manager.planner_began(facts.run)
        await manager.step()
        if turn == 0:
            assert (await client.ask("PUT", "/zones/ramp", RAMP))[0] == 201
            assert (await client.ask("PATCH", "/robots/Robot1", {"profile": profile}))[0] == 200
            assert (await client.ask("POST", "/tasks", {"stops": stops}))[0] == 201
        (robot,) = planner.core.snapshot().robots
        plan = max(plan, robot.plan, key=len)
    await manager.close()
    assert (plan[0], plan[-1], list(plan) == STRAIGHT) == (5, 9, is_straight)
    assert is_straight or set(plan).isdisjoint({6, 7, 8})


def test_the_planner_is_told_own_costs_once() -> None:
    """Again after its restart, after a restart of the manager, and some time after it refused."""
    both = Both()
    both.book.emit(RobotEntry("Robot1", profile=RobotProfile(zone_cost=DEAR)), "profile", 0.0)
    told = SetCosts({"Robot1": DEAR})
    assert both.step(refused=True) == [told]
    assert both.step() == []
    assert both.step(REFUSED_S) == [told]
    assert (both.step(), both.costs) == ([], {"Robot1": DEAR})
    assert Both(both.book).step() == [told]
    both.sync.begin(replace(RUN, started="2.0"), both.now)
    assert both.step() == [told]
    both.book.emit(RobotEntry("Robot1"), "profile", 0.0)
    assert both.step() == [SetCosts({})]


def test_costs_that_cannot_be_are_refused() -> None:
    planner = FleetPlanner(GRID)
    for factor in (nan, 0.0, -1.0, 1e9):
        (reply,) = planner.handle(CostsSet({"Robot1": {"ramp": factor}}), 0.0)
        assert isinstance(reply, Reply)
        assert (reply.ok, "counts 0.01 .. 1e+06 for Robot1" in reply.message) == (False, True)
    message: Any = SimpleNamespace(robots=["Robot1"], zones=["ramp", "gate"], costs=[2.0])
    with pytest.raises(ValueError, match="as many entries each, not 1, 2, 1"):
        read_costs_set(message)


def test_own_costs_stay_with_another_grid() -> None:
    planner = FleetPlanner(GRID)
    assert planner.handle(CostsSet({"Robot1": DEAR}), 0.0) == [
        Reply(True, "1 robots have costs of their own in zones")
    ]
    other, _ = next_planner(planner, GridMap(6, 6), 1.0)
    assert other.state.zones.own_costs == {"Robot1": DEAR}
