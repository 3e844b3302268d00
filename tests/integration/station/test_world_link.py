"""The station changes a real simulated world, and shows its truth."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from support.engine import Program

from rce.aio.tasks import cancel_and_wait
from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce_fleet.station import world_link
from rce_fleet.station.world_link import WorldError, WorldLink, WorldRequest

SCENE = """
robots: [{id: Robot1, at: [1, 1]}]
light_robots: [{id: Light1, cell: 40}]
boxes: [{id: box1, at: [4, 4], size: [0.5, 0.5]}]
"""
LIMIT_S = 60
Until = Callable[..., Awaitable[None]]


@pytest.mark.needs("pymunk")
async def test_an_operator_changes_a_simulated_world(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    argv = [sys.executable, "-c", "from rce.cli import main; main()", "sim", str(tmp_path / "scene.yaml")]
    program = Program("sim", [*argv, "--core-port", "0", "--world-port", "0"], dict(os.environ), tmp_path)
    await program.start(ready="simulation ready:")
    (line,) = [line for line in program.output().splitlines() if line.startswith("world ")]
    known: dict[str, list[Any]] = {}
    told: dict[str, Any] = {}

    def take(states: list[list[Any]]) -> None:
        known.clear()
        known.update({name: place for name, *place in states})

    async def until_place(name: str, x: float, y: float) -> None:
        async with asyncio.timeout(LIMIT_S):
            while known.get(name, [None, None])[:2] != pytest.approx([x, y], abs=0.05):
                await asyncio.sleep(0.05)

    async def until_told(thing: str, what: list[Any] | None, *, paused: bool) -> None:
        async with asyncio.timeout(LIMIT_S):
            while told.get("things", {}).get(thing) != what or told["paused"] is not paused:
                await asyncio.sleep(0.05)

    uri, types = line.split("ROS_MASTER_URI=")[1], TypeRegistry(PackageIndex([]))
    world = WorldLink(uri, types, take, on_things=told.update)
    running = asyncio.create_task(world.run())
    try:
        await until_place("box1", 4, 4)
        await until_place("Robot1", 1, 1)
        await until_told("Light1", ["light"], paused=False)
        await world.act(WorldRequest(action="add_box", name="box2", x=6, y=2))
        await until_place("box2", 6, 2)
        await until_told("box2", ["box", 0.6, 0.6], paused=False)
        await check_people(world, until_place, until_told)
        await world.act(WorldRequest(action="move", name="Robot1", x=3, y=6, yaw=1.0))
        await until_place("Robot1", 3, 6)
        assert known["Robot1"][2] == pytest.approx(1.0, abs=0.05)
        await world.act(WorldRequest(action="remove", name="box2"))
        async with asyncio.timeout(LIMIT_S):
            while "box2" in known:
                await asyncio.sleep(0.05)
        with pytest.raises(WorldError, match="box9"):
            await world.act(WorldRequest(action="remove", name="box9"))
        said = await world.act(WorldRequest(action="add_robot", name="Robot9", x=6, y=6))
        assert "it joins the fleet once" in said
        await world.act(WorldRequest(action="reset"))
        await until_place("Robot1", 1, 1)
        await check_starts(world, until_place, until_told)
        await world.act(WorldRequest(action="remove", name="Light1"))
        await until_told("Light1", None, paused=False)
        with pytest.raises(WorldError, match="Light1"):
            await world.act(WorldRequest(action="move", name="Light1", x=2, y=2))
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        assert await program.stop() == 0


async def check_people(world: WorldLink, until_place: Until, until_told: Until) -> None:
    """A person stands or walks, is moved and taken out; a place that is taken is refused."""
    await world.act(WorldRequest(action="add_person", name="person1", x=2, y=5))
    await until_told("person1", ["walker", 0.2], paused=False)
    await until_place("person1", 2, 5)
    await world.act(WorldRequest(action="move", name="person1", x=2, y=6))
    await until_place("person1", 2, 6)
    await world.act(WorldRequest(action="add_person", name="person2", x=5, y=6, to=(5, 7)))
    await until_place("person2", 5, 7)
    with pytest.raises(WorldError, match="person1"):
        await world.act(WorldRequest(action="add_person", name="person3", x=2.1, y=6))
    for name in ("person1", "person2"):
        await world.act(WorldRequest(action="remove", name=name))
        await until_told(name, None, paused=False)


async def check_starts(world: WorldLink, until_place: Until, until_told: Until) -> None:
    """Robots that are moved while the world is paused start there after a reset."""
    await world.act(WorldRequest(action="pause"))
    await until_told("Robot1", ["robot"], paused=True)
    for name, x in (("Robot1", 5.0), ("Light1", 2.0)):
        said = await world.act(WorldRequest(action="move", name=name, x=x, y=2.5))
        assert said.endswith(f"{name} starts there")
        await until_place(name, x, 2.5)
    await world.act(WorldRequest(action="resume"))
    await world.act(WorldRequest(action="move", name="Robot1", x=6, y=4))
    await until_place("Robot1", 6, 4)
    await world.act(WorldRequest(action="reset"))
    await until_place("Robot1", 5, 2.5)
    await until_place("Light1", 2, 2.5)


async def test_pages_come_and_go_while_the_world_is_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """The world's truth is there again once its ROS master is."""
    monkeypatch.setattr(world_link, "LOOK_AWAY_S", 0.05)
    types, wanted, told = TypeRegistry(PackageIndex([])), asyncio.Event(), asyncio.Event()
    wanted.set()

    async def until_told(core: Core) -> None:
        async with Node("world", argv=[], master_uri=core.uri, types=types, signals=False) as node:
            states = await node.advertise("/gazebo/model_states", "gazebo_msgs/ModelStates", latch=True)
            states.publish(name=["box1"], pose=[{}])
            told.clear()
            async with asyncio.timeout(LIMIT_S):
                await told.wait()

    async with Core(port=0) as core:
        link = WorldLink(core.uri, types, lambda _: told.set(), wanted)
        running = asyncio.create_task(link.run())
        await until_told(core)
    wanted.clear()
    await asyncio.sleep(0.5)
    wanted.set()
    await asyncio.sleep(0.5)
    async with Core(port=int(core.uri.rstrip("/").rpartition(":")[2])) as again:
        assert not running.done()
        await until_told(again)
        await cancel_and_wait(running)
