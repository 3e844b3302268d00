"""A fleet on one ROS core with planner, fleet manager, move clients and simulated robots."""

from __future__ import annotations

import asyncio
import json
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rce.ros.core import Core
from rce.ros.errors import RosError
from rce.ros.node import Node
from rce.ros.types import TypeRegistry
from rce_fleet.drivers.program import run_world
from rce_fleet.drivers.robot_driver import RobotDriver
from rce_fleet.planning.grid import GridMap
from rce_fleet.simulation.battery import Battery, BatterySpec
from rce_fleet.simulation.world import World
from support.resting_robot import PACKAGES, fleet_program

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from rce.ros.types import Message

LONGEST_S = 240.0


@dataclass(frozen=True, slots=True)
class Said:
    """An answer of the manager."""

    status: int
    body: Any
    revision: str


class ManagedFleet:
    """Robots ``Robot1`` ... on a floor, and a client of the manager.

    Args:
        core: The ROS core.
        journal: File of the manager's journal.
        starts: Cells of the robots.
        grid: The floor.
        pace: How much faster than real time the robots are.
        parameters: Parameters of the manager, as words of its command line.
    """

    def __init__(
        self,
        core: Core,
        journal: Path,
        starts: list[int],
        grid: GridMap | None = None,
        pace: float = 4.0,
        parameters: tuple[str, ...] = (),
    ) -> None:
        self.core = core
        self.grid = grid or GridMap()
        self.world = World(self.grid, seed=3)
        self.events: list[dict[str, Any]] = []
        self._journal = journal
        self._pace = pace
        self._parameters = parameters
        self._programs: dict[str, tuple[AsyncExitStack, asyncio.subprocess.Process]] = {}
        self._node: Node
        for number, cell in enumerate(starts, 1):
            self.world.add_robot(f"Robot{number}", cell, 0.0)

    @asynccontextmanager
    async def running(self) -> AsyncIterator[ManagedFleet]:
        """Run everything; at the end all programs are stopped."""
        types = TypeRegistry(PACKAGES)
        async with AsyncExitStack() as stack:
            stack.push_async_callback(self._stop_all)
            await self.start("fleet_planner.py")
            await self.start("fleet_manager.py")
            drivers = []
            for robot in self.world.robots:
                await stack.enter_async_context(fleet_program(self.core, "move_client.py", f"__ns:={robot}"))
                node = Node("robot", namespace=robot, argv=[], master_uri=self.core.uri, types=types)
                drivers.append(RobotDriver(await stack.enter_async_context(node), self.world, robot))
                await drivers[-1].start()
            self._node = await stack.enter_async_context(
                Node("erp", argv=[], master_uri=self.core.uri, types=types)
            )
            await self._node.subscribe(
                "/fleet/events",
                "std_msgs/String",
                lambda message: self.events.append(json.loads(message.data)),
            )
            tasks = await stack.enter_async_context(asyncio.TaskGroup())
            moving = tasks.create_task(run_world(self.world, drivers, pace=self._pace))
            stack.callback(moving.cancel)
            yield self

    async def start(self, exe: str) -> None:
        """Start planner or manager."""
        stack = AsyncExitStack()
        options = [f"_journal:={self._journal}", *self._parameters] if exe == "fleet_manager.py" else []
        walls = sorted(self.grid.blocked)
        if exe == "fleet_planner.py":
            options = [f"_walls:={walls}", f"_rows:={self.grid.rows}", f"_columns:={self.grid.columns}"]
        process = await stack.enter_async_context(fleet_program(self.core, exe, *options))
        self._programs[exe] = stack, process

    async def kill(self, exe: str) -> None:
        """Kill planner or manager, as ``kill -9`` does."""
        stack, process = self._programs.pop(exe)
        process.kill()
        await process.wait()
        stack.pop_all()

    def signal(self, exe: str, number: int) -> None:
        """Send a signal to planner or manager."""
        self._programs[exe][1].send_signal(number)

    async def planner_zones(self) -> list[str]:
        """Return the ids of the planner's zones."""
        answer = await self._node.service_client("/fleet/get_state", "fleet/GetState").call({}, timeout=30)
        return [str(zone.id) for zone in answer.state.zones]

    async def lose_journal(self) -> None:
        """Kill the manager, remove its journal, and start it again: as a container without a volume does."""
        await self.kill("fleet_manager.py")
        for file in self._journal.parent.glob(f"{self._journal.name}*"):
            file.unlink()
        await self.start("fleet_manager.py")

    async def ask(self, method: str, path: str, body: Any = None, **fields: str) -> Said:
        """Send a request to the manager; it is sent again while no manager answers."""
        request = {
            "method": method,
            "path": path,
            "body": "" if body is None else json.dumps(body),
            "user": "erp",
            "role": "operator",
            **fields,
        }
        async with asyncio.timeout(LONGEST_S):
            while True:
                try:
                    client = self._node.service_client("/fleet/request", "fleet/Request")
                    answer = await client.call(request, timeout=30)
                except Exception:  # noqa: BLE001 - the manager is away, in any way
                    await asyncio.sleep(0.1)
                    continue
                return Said(answer.status, json.loads(answer.body), answer.revision)

    async def call(self, service: str, service_type: str, **fields: Any) -> Message | None:
        """Call a service; None: it does not answer now."""
        try:
            return await self._node.service_client(service, service_type).call(fields, timeout=30)
        except RosError:
            return None

    async def set_battery(self, robot: str, share: float) -> None:
        """Set a robot's battery; wait until the manager knows it, and that the robot is idle."""
        self.world.robots[robot].battery = Battery(BatterySpec(capacity=60.0, charge=share))
        shown: dict[str, Any] = {}
        async with asyncio.timeout(LONGEST_S):
            while shown.get("state") != "idle" or abs((shown["battery"] or 0.0) - share) > 0.01:
                await asyncio.sleep(0.2)
                shown = (await self.ask("GET", f"/robots/{robot}")).body

    async def until_state(self, task: str, *states: str) -> dict[str, Any]:
        """Wait until a task is in one of some states; return it."""
        shown: dict[str, Any] = {}
        try:
            async with asyncio.timeout(LONGEST_S):
                while True:
                    shown = (await self.ask("GET", f"/tasks/{task}")).body
                    if shown["state"] in states:
                        return shown
                    await asyncio.sleep(0.2)
        except TimeoutError as error:
            raise AssertionError(f"{task} is not {states}: {shown}") from error

    async def until_standing(self, robot: str) -> int | None:
        """Wait until a robot that is not driven has come to rest; return its cell."""
        body = self.world.robots[robot]
        async with asyncio.timeout(LONGEST_S):
            before = None
            while body.pose != before:
                before = body.pose
                await asyncio.sleep(1.0)
        return self.grid.cell_at(body.pose.x, body.pose.y)

    async def _stop_all(self) -> None:
        for stack, _ in self._programs.values():
            await stack.aclose()


@asynccontextmanager
async def managed_fleet(journal: Path, starts: list[int], **options: Any) -> AsyncIterator[ManagedFleet]:
    """Run a managed fleet on a core of its own."""
    async with Core(port=0) as core, ManagedFleet(core, journal, starts, **options).running() as fleet:
        yield fleet
