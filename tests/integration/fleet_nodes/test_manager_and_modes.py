"""Modes, zones and goals of the fleet manager at a real planner, whose process is killed in between."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from support.managed_fleet import ManagedFleet, managed_fleet

LONGEST_S = 90.0


async def until(found: Callable[[], Awaitable[bool]]) -> None:
    """Wait until something is so."""
    async with asyncio.timeout(LONGEST_S):
        while not await found():
            await asyncio.sleep(0.1)


async def state_of(fleet: ManagedFleet) -> dict[str, Any]:
    """Return robots' states and modes, zones and blocked cells, as the planner has them."""
    answer = await fleet.call("/fleet/get_state", "fleet/GetState")
    if answer is None:
        return {"robots": {}, "goals": {}, "zones": set(), "blocked": set()}
    state = answer.state
    return {
        "robots": {robot.id: robot.mode for robot in state.robots},
        "goals": {robot.id: robot.goal for robot in state.robots},
        "zones": {zone.id for zone in state.zones},
        "blocked": set(state.blocked),
        "blocks": {(block.cell, block.by, block.reason, block.lifetime > 0) for block in state.blocks},
    }


async def test_modes_and_zones_survive_the_planner(tmp_path: Path) -> None:
    async with managed_fleet(tmp_path / "journal.sqlite", [0, 7]) as fleet:
        spill = {"kind": "blocked", "cells": [26, 27], "reason": "oil", "robots": []}
        ice = {"kind": "slow", "cells": [30], "value": 0.2}
        async with asyncio.timeout(LONGEST_S):
            while (await fleet.ask("POST", "/robots/Robot1/pause", {"reason": "tea"})).status != 200:
                await asyncio.sleep(0.2)  # it has not joined yet
        assert (await fleet.ask("PUT", "/zones/spill", spill)).status == 201
        assert (await fleet.ask("PUT", "/zones/ice", ice)).status == 201
        async with asyncio.timeout(LONGEST_S):
            while (await fleet.ask("PUT", "/robots/Robot2/goal", {"cell": 47})).status != 200:
                await asyncio.sleep(0.2)
        hole = {"cell": 40, "blocked": True, "reason": "hole", "by": "eve", "lifetime": 3600.0}
        blocked = await fleet.call("/fleet/block_cell", "fleet/BlockCell", **hole)
        assert blocked is not None
        assert blocked.ok

        async def is_told() -> bool:
            state = await state_of(fleet)
            return (
                bool(state["robots"].get("Robot1") == "paused")
                and bool(state["zones"] == {"spill", "ice"})
                and {26, 27, 40} <= state["blocked"]
                and bool(state["blocks"] == {(40, "eve", "hole", True)})
                and bool(state["goals"].get("Robot2") == 47)
            )

        await until(is_told)

        async def is_kept() -> bool:
            page = (await fleet.ask("GET", "/events?after=0&limit=5000")).body
            return "blocked" in {event["name"] for event in page["events"]}

        await until(is_kept)
        await fleet.kill("fleet_planner.py")
        await fleet.start("fleet_planner.py")
        await until(is_told)
        shown = (await fleet.ask("GET", "/robots/Robot1")).body
        assert (shown["mode"], shown["activity"], shown["reason"]) == ("paused", "paused", "tea")

        task = (await fleet.ask("POST", "/tasks", {"stops": [{"cell": 5}], "robot": "Robot1"})).body["id"]
        assert (await fleet.ask("POST", "/robots/Robot1/resume")).body["mode"] == "automatic"
        await fleet.until_state(task, "done")
        out = await fleet.call(
            "/fleet/set_mode", "fleet/SetMode", robot="Robot2", mode="out_of_service", reason="flat", by="eve"
        )
        assert out is not None
        assert out.ok

        async def is_out() -> bool:
            return bool((await fleet.ask("GET", "/robots/Robot2")).body["activity"] == "out")

        await until(is_out)
        assert (await fleet.ask("GET", "/robots/Robot2")).body["reason"] == "flat, by eve"


async def test_ends_of_zones_follow_the_side_that_changed_them(tmp_path: Path) -> None:
    """A program makes its zone permanent at the planner; a request gives it an end while that is stopped."""
    async with managed_fleet(tmp_path / "journal.sqlite", [0]) as fleet:

        async def set_at_planner(lifetime: float) -> None:
            gate = {"id": "gate", "kind": "blocked", "cells": [27], "lifetime": lifetime}
            answer = await fleet.call("/fleet/set_zones", "fleet/SetZones", zones=[gate], revision=-1)
            assert answer is not None
            assert answer.ok, answer.message

        async def end_at_manager() -> Any:
            return (await fleet.ask("GET", "/zones/gate")).body.get("until", "not known")

        async def ends_in_an_hour() -> bool:
            return isinstance(end := await end_at_manager(), float) and end > time.time() + 3000.0

        async def is_permanent() -> bool:
            return await end_at_manager() is None

        async def is_told_of_its_end() -> bool:
            answer = await fleet.call("/fleet/get_state", "fleet/GetState")
            return answer is not None and [zone.lifetime > 3000.0 for zone in answer.state.zones] == [True]

        async with asyncio.timeout(LONGEST_S):
            while await fleet.call("/fleet/get_state", "fleet/GetState") is None:
                await asyncio.sleep(0.2)
        await set_at_planner(3600.0)
        await until(ends_in_an_hour)
        await set_at_planner(0.0)
        await until(is_permanent)
        fleet.signal("fleet_planner.py", signal.SIGSTOP)
        await asyncio.sleep(8.0)  # the manager notices after 5 s; else its call is only late
        gate = {"kind": "blocked", "cells": [27], "until": time.time() + 7200.0}
        assert (await fleet.ask("PUT", "/zones/gate", gate)).status == 200
        fleet.signal("fleet_planner.py", signal.SIGCONT)
        await until(is_told_of_its_end)


async def test_a_task_goes_to_the_robot_that_need_not_drive_around_a_one_way_zone(tmp_path: Path) -> None:
    """Cell 4 is three cells from Robot2, but against the zone's direction; around it are five."""
    async with managed_fleet(tmp_path / "journal.sqlite", [0, 7]) as fleet:

        async def are_ready() -> bool:
            robots = (await state_of(fleet))["robots"]
            return bool(robots == {"Robot1": "automatic", "Robot2": "automatic"})

        await until(are_ready)
        aisle = {"kind": "one_way", "cells": [1, 2, 3, 4, 5, 6], "value": 0.0}
        async with asyncio.timeout(LONGEST_S):
            while (await fleet.ask("PUT", "/zones/aisle", aisle)).status != 201:
                await asyncio.sleep(0.2)
        created = await fleet.ask("POST", "/tasks", {"stops": [{"cell": 4}]})
        task = await fleet.until_state(created.body["id"], "done")
        assert task["robot_assigned"] == "Robot1"


async def test_a_one_way_zone_for_one_robot_lets_others_pass(tmp_path: Path) -> None:
    """Robot1 drives around a zone that is for it, and through one that is for Robot2, against both."""
    async with managed_fleet(tmp_path / "journal.sqlite", [4, 63]) as fleet:
        body = fleet.world.robots["Robot1"]

        async def rows_on_the_way(cell: int) -> set[int]:
            """Send Robot1 to a cell; return the rows in which it was."""
            task = (await fleet.ask("POST", "/tasks", {"stops": [{"cell": cell}], "robot": "Robot1"})).body
            arriving = asyncio.create_task(fleet.until_state(task["id"], "done"))
            rows = set()
            while not arriving.done():
                at = fleet.grid.cell_at(body.pose.x, body.pose.y)
                assert at is not None
                rows.add(at // fleet.grid.columns)
                await asyncio.sleep(0.02)
            await arriving
            return rows

        for robot, rows in (("Robot1", {0, 1}), ("Robot2", {0})):
            zone = {"kind": "one_way", "cells": [1, 2, 3, 4, 5, 6], "value": 0.0, "robots": [robot]}
            async with asyncio.timeout(LONGEST_S):
                while (await fleet.ask("PUT", "/zones/aisle", zone)).status not in (200, 201):
                    await asyncio.sleep(0.2)
            assert await rows_on_the_way(1) == rows
            assert await rows_on_the_way(4) == {0}
        assert fleet.world.collisions.total == 0
