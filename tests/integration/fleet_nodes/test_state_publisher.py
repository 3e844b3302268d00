"""What the planner's node publishes of its state, and how much of it."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce_fleet.coordination.events import CellBlocked, CellFreed, PoseSeen
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.nodes.state_publisher import WHOLE_ROBOTS_PER_S, StatePublisher
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

ROBOTS = 60


class Outside:
    """A planner with its publisher, and what a subscriber hears of it."""

    def __init__(self, node: Node) -> None:
        self.planner = FleetPlanner(GridMap(20, 20))
        self.publisher = StatePublisher(node, self.planner)
        self.node = node
        self.states: list[Any] = []
        self.changes: list[Any] = []
        self.now = 0.0

    def tick(self) -> None:
        self.now += 0.1
        self.publisher.update(self.now)

    async def heard(self) -> None:
        """Wait until everything that was published has been heard."""
        service = self.node.service_client("/fleet/get_state", "fleet/GetState")
        number = (await service()).sequence
        async with asyncio.timeout(60):
            while not self.changes or self.changes[-1].sequence != number:
                await asyncio.sleep(0)


@asynccontextmanager
async def outside() -> AsyncIterator[Outside]:
    types = TypeRegistry(PackageIndex([]))
    async with (
        Core(port=0) as core,
        Node("planner", argv=[], master_uri=core.uri, types=types, signals=False) as node,
        Node("station", argv=[], master_uri=core.uri, types=types, signals=False) as station,
    ):
        made = Outside(node)
        await made.publisher.start()
        await station.subscribe("/fleet/state", "fleet/FleetState", made.states.append)
        changes = await station.subscribe("/fleet/changes", "fleet/FleetChanges", made.changes.append)
        await changes.wait_for_publishers()
        for robot in range(ROBOTS):
            made.planner.handle(PoseSeen(f"Robot{robot}", robot % 20 + 0.5, robot // 20 + 0.5, 0.0), 0.0)
        made.tick()
        await made.heard()
        yield made


async def test_changes_name_what_changed_and_nothing_else() -> None:
    async with outside() as made:
        assert [len(change.robots) for change in made.changes] == [ROBOTS]
        made.planner.handle(CellBlocked(399, by="ann", reason="spill", expires=60.1), 0.1)
        made.tick()
        await made.heard()
        change = made.changes[-1]
        assert (list(change.blocked), list(change.robots), change.sequence) == ([399], [], 2)
        (block,) = change.blocks
        assert (block.cell, block.sensed, block.by, block.reason) == (399, False, "ann", "spill")
        assert (block.age, block.lifetime) == (pytest.approx(0.1), pytest.approx(59.9))
        made.planner.handle(CellFreed(399), 0.2)
        made.tick()
        await made.heard()
        change = made.changes[-1]
        assert (list(change.freed), list(change.removed_blocks), change.blocks) == ([399], [399], [])


async def test_number_is_repeated_while_nothing_changes() -> None:
    async with outside() as made:
        for _ in range(35):
            made.tick()
        await made.node.service_client("/fleet/get_state", "fleet/GetState")()
        async with asyncio.timeout(60):
            while len(made.changes) < 4:
                await asyncio.sleep(0)
        assert [change.sequence for change in made.changes] == [1, 1, 1, 1]
        assert not any(change.robots for change in made.changes[1:])


async def test_whole_states_are_bounded_and_end_with_the_last_change() -> None:
    """Something changes with each tick, for 12 s."""
    async with outside() as made:
        before = len(made.states)
        for number in range(120):
            cell = 390 + number % 2
            made.planner.handle(CellBlocked(cell) if number % 4 < 2 else CellFreed(cell), made.now)
            made.tick()
            if number % 20 == 19:
                await made.heard()  # before the subscriber's queue drops the oldest
        assert [change.sequence for change in made.changes] == list(range(1, 122))
        for _ in range(5):
            made.tick()
        blocked = sorted(made.planner.state.blocked)
        async with asyncio.timeout(60):
            while list(made.states[-1].blocked) != blocked:
                await asyncio.sleep(0)
        told = sum(len(state.robots) for state in made.states[before:])
        assert 0 < told <= WHOLE_ROBOTS_PER_S * 12.5 + ROBOTS
