"""The planner's changes over ROS: a station that joins late, misses some, and outlives the planner."""

from __future__ import annotations

import asyncio
import os
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce_fleet.station import fleet_link
from rce_fleet.station.desired import DesiredCell
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.planner_client import PlannerUnavailableError
from rce_fleet.station.ros_planner_client import RosPlannerClient
from rce_fleet.station.view import FleetView, Pose, ViewChange

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    import pytest

PACKAGES = PackageIndex([])
WAIT_S = 60.0


@asynccontextmanager
async def planner(core: Core) -> AsyncIterator[asyncio.subprocess.Process]:
    """The planner's node as a process; it is killed at the end."""
    command = PACKAGES.find("fleet").executable("fleet_planner.py")
    process = await asyncio.create_subprocess_exec(*command, env={**os.environ, "ROS_MASTER_URI": core.uri})
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


class Client(RosPlannerClient):
    """Tells when whole states are not needed any more, and when they are again."""

    follows_changes = False

    def __init__(self, master_uri: str, types: TypeRegistry) -> None:
        super().__init__(master_uri, types)
        self.needs_states = asyncio.Event()

    def stop_states(self) -> None:
        self.follows_changes = True
        super().stop_states()

    def receive_states(self) -> None:
        self.needs_states.set()
        super().receive_states()


class LossyLink(FleetLink):
    """Counts whole states, and loses changes when a test says so."""

    states = 0
    loses_changes = False

    def take_state(self, message: dict[str, Any]) -> None:
        self.states += 1
        super().take_state(message)

    def take_changes(self, message: dict[str, Any]) -> None:
        has_content = any(message[part] for part in ("robots", "removed", "blocked", "pending", "freed"))
        if not (self.loses_changes and has_content):
            super().take_changes(message)


class Station:
    """A station in the planner's ROS graph, and what it heard."""

    def __init__(self, core: Core) -> None:
        self.view = FleetView()
        self.changes: list[ViewChange] = []
        self.events: list[str] = []
        self.client = Client(core.uri, TypeRegistry(PACKAGES))
        self.link = LossyLink(
            self.client,
            self.view,
            on_change=self._take,
            on_pose=lambda _: self._changed.set(),
            on_event=lambda text, _: self.events.append(text),
        )
        self._changed = asyncio.Event()

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        ready = asyncio.Event()

        async def announce() -> None:
            ready.set()

        task = asyncio.create_task(self.link.run(announce))
        try:
            async with asyncio.timeout(WAIT_S):
                await ready.wait()
            yield
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(WAIT_S):
            while not condition():
                self._changed.clear()
                await self._changed.wait()

    async def block(self, cell: int) -> None:
        """Block a cell, as soon as a planner that is starting takes requests."""
        async with asyncio.timeout(WAIT_S):
            while True:
                try:
                    await self.link.block_cell(DesiredCell(cell, True))
                except PlannerUnavailableError:
                    await asyncio.sleep(0.1)
                else:
                    return

    def _take(self, change: ViewChange) -> None:
        self.changes.append(change)
        self._changed.set()


async def put_robot(core: Core, stack: AsyncExitStack, name: str, x: float, y: float) -> None:
    """Let a robot say where it is; it has no move client, so it stays ``joining``."""
    node = await stack.enter_async_context(
        Node(name, argv=[], master_uri=core.uri, types=TypeRegistry(PACKAGES), signals=False)
    )
    topic, kind = f"/{name}/amcl_pose", "geometry_msgs/PoseWithCovarianceStamped"
    publisher = await node.advertise(topic, kind, latch=True)
    pose = {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}}
    publisher.publish(pose={"pose": pose})


async def test_a_station_follows_changes_and_stops_whole_states() -> None:
    async with Core(port=0) as core, AsyncExitStack() as stack, planner(core):
        first = Station(core)
        async with first.running():
            await first.until(lambda: first.client.follows_changes)
            await put_robot(core, stack, "Robot1", 0.5, 0.5)
            await first.until(lambda: first.view.robot_ids() == ["Robot1"])
            await first.until(lambda: first.view.poses == {"Robot1": Pose(0.5, 0.5, 0.0)})
            await first.block(9)
            await first.until(lambda: first.view.blocked() == [9])
            states = first.link.states
            for count, cell in enumerate((10, 11, 12), start=2):
                await first.block(cell)
                await first.until(lambda count=count: len(first.view.blocked()) == count)  # type: ignore[misc]  # mypy cannot type a lambda's default
            assert first.link.states == states
            assert [change.blocked for change in first.changes if change.blocked][-3:] == [
                (10,),
                (11,),
                (12,),
            ]
        late = Station(core)
        async with late.running():
            await late.until(lambda: late.client.follows_changes)
            assert late.view.blocked() == [9, 10, 11, 12]
            assert late.view.robot_ids() == ["Robot1"]
            await late.until(lambda: late.view.poses == {"Robot1": Pose(0.5, 0.5, 0.0)})


async def test_missed_last_change_makes_a_station_ask_for_the_state() -> None:
    async with Core(port=0) as core, planner(core):
        station = Station(core)
        async with station.running():
            await station.until(lambda: station.client.follows_changes)
            station.link.loses_changes = True
            await station.block(9)
            await station.until(lambda: station.view.blocked() == [9])


async def test_a_station_follows_the_planner_that_comes_after() -> None:
    """The new planner numbers its changes from 1 again, and is told what the former one knew."""
    async with Core(port=0) as core, planner(core) as process:
        station = Station(core)
        async with station.running():
            await station.until(lambda: station.client.follows_changes)
            await station.block(9)
            await station.until(lambda: station.view.blocked() == [9])
            before = len(station.changes)
            process.kill()
            await process.wait()
            async with planner(core):
                await station.until(lambda: any(change.freed for change in station.changes[before:]))
                await station.until(lambda: station.view.blocked() == [9])
            assert any("the planner was restarted" in text for text in station.events)


async def test_an_earlier_planner_is_followed_by_its_whole_states() -> None:
    """A planner of the release before publishes ``/fleet/state`` and nothing else."""
    async with (
        Core(port=0) as core,
        Node("planner", argv=[], master_uri=core.uri, types=TypeRegistry(PACKAGES), signals=False) as node,
    ):
        states = await node.advertise("/fleet/state", "fleet/FleetState", latch=True)
        states.publish(rows=4, columns=4, cell_size=1.0, blocked=[1])
        station = Station(core)
        async with station.running():
            await station.until(lambda: station.view.blocked() == [1])
            states.publish(rows=4, columns=4, cell_size=1.0, blocked=[2])
            await station.until(lambda: station.view.blocked() == [2])
            assert station.changes[-1] == ViewChange(blocked=(2,), freed=(1,))
            assert not station.client.follows_changes


async def test_an_earlier_planner_may_replace_a_newer_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its whole states are followed until a newer planner takes its place again."""
    monkeypatch.setattr(fleet_link, "SILENT_S", 2.0)
    async with Core(port=0) as core:
        station = Station(core)
        async with AsyncExitStack() as stack:
            async with planner(core):
                await stack.enter_async_context(station.running())
                await station.until(lambda: station.client.follows_changes)
            async with Node(
                "planner", argv=[], master_uri=core.uri, types=TypeRegistry(PACKAGES), signals=False
            ) as node:
                states = await node.advertise("/fleet/state", "fleet/FleetState", latch=True)
                states.publish(rows=4, columns=4, cell_size=1.0, blocked=[1])
                await station.until(lambda: station.view.blocked() == [1])
                states.publish(rows=4, columns=4, cell_size=1.0, blocked=[2])
                await station.until(lambda: station.view.blocked() == [2])
                station.client.follows_changes = False
            async with planner(core):
                await station.until(lambda: station.client.follows_changes)
                await station.block(9)
                await station.until(lambda: station.view.blocked() == [9])
        told = [text for text in station.events if "publishes no changes" in text]
        assert len(told) == 1


async def test_a_station_outlives_core_and_planner(monkeypatch: pytest.MonkeyPatch) -> None:
    """It asks for whole states while both are away, and follows the planner that comes after."""
    monkeypatch.setattr(fleet_link, "SILENT_S", 2.0)
    async with AsyncExitStack() as stack:
        async with Core(port=0) as core, planner(core):
            station = Station(core)
            await stack.enter_async_context(station.running())
            await station.until(lambda: station.client.follows_changes)
            await station.block(9)
            await station.until(lambda: station.view.blocked() == [9])
        async with asyncio.timeout(WAIT_S):
            await station.client.needs_states.wait()
        await asyncio.sleep(0.5)  # it has tried to subscribe
        station.client.follows_changes = False
        async with Core(port=int(core.uri.rstrip("/").rpartition(":")[2])) as again, planner(again):
            await station.until(lambda: station.client.follows_changes)
            await station.block(10)
            await station.until(lambda: station.view.blocked() == [9, 10])
