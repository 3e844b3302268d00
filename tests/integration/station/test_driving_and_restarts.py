"""The mode of a robot that is driven by hand while the station ends, crashes, or its planner is away."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from aiohttp import ClientSession, ClientWebSocketResponse

from rce.ros.core import Core
from rce.ros.node import Node, Publisher
from rce.ros.packages import PackageIndex
from rce.ros.types import Message, TypeRegistry

pytestmark = pytest.mark.timeout(240)

TYPES = TypeRegistry(PackageIndex([]))
LIMIT_S = 90
GRID = {"rows": 2, "columns": 2, "cell_size": 1.0, "mode": "automatic"}


class Planner:
    """The part of a planner that sets modes; one robot, which listens to who drives it."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._states: Publisher
        self.mode = "paused"
        self.refuses = False
        self.refused = asyncio.Event()
        self.changed = asyncio.Condition()

    async def start(self) -> None:
        self._states = await self._node.advertise("/fleet/state", "fleet/FleetState", latch=True)
        self._publish()
        await self._node.advertise_service("/fleet/set_mode", "fleet/SetMode", self._set_mode)
        await self._node.subscribe("/Robot1/raw_cmd_vel", "geometry_msgs/Twist", lambda _: None)

    async def until(self, mode: str) -> None:
        async with asyncio.timeout(LIMIT_S), self.changed:
            await self.changed.wait_for(lambda: self.mode == mode)

    async def _set_mode(self, request: Message) -> dict[str, Any]:
        if self.refuses and request.mode != "manual":
            self.refused.set()
            return {"ok": False, "message": "not now"}
        async with self.changed:
            self.mode = request.mode
            self.changed.notify_all()
        self._publish()
        return {"ok": True, "message": ""}

    def _publish(self) -> None:
        robot = {"id": "Robot1", "cell": 0, "goal": -1, "state": self.mode, "mode": self.mode}
        self._states.publish(**GRID, robots=[robot])


@asynccontextmanager
async def planner() -> AsyncIterator[tuple[str, Planner]]:
    async with Core(port=0) as core, Node("planner", argv=[], master_uri=core.uri, types=TYPES) as node:
        made = Planner(node)
        await made.start()
        yield core.uri, made


class RunningStation:
    """The program, and a browser that drives the robot."""

    def __init__(self, process: asyncio.subprocess.Process, url: str, browser: ClientSession) -> None:
        self.process = process
        self._url = url
        self._browser = browser

    @asynccontextmanager
    async def driving(self) -> AsyncIterator[ClientWebSocketResponse]:
        url = f"{self._url}api/v1/robots/Robot1"
        async with asyncio.timeout(LIMIT_S):
            while (await self._browser.get(url)).status != 200:
                await asyncio.sleep(0.05)
        async with self._browser.ws_connect(f"{url}/drive") as page:
            await page.send_str(json.dumps({"number": 0, "sent": 0.0, "held": True, "speed": 0.2}))
            assert "reason" in json.loads(await page.receive_str(timeout=LIMIT_S))
            yield page

    async def recorded(self) -> float:
        """Wait until there is something to replay; return the time of the first record."""
        async with asyncio.timeout(LIMIT_S):
            while True:
                async with self._browser.get(f"{self._url}api/v1/replay") as reply:
                    first: float | None = (await reply.json())["first"]
                if first is not None:
                    return first
                await asyncio.sleep(0.05)

    async def end(self, number: signal.Signals) -> None:
        self.process.send_signal(number)
        async with asyncio.timeout(LIMIT_S):
            await self.process.wait()


@asynccontextmanager
async def station(master: str, folder: Path) -> AsyncIterator[RunningStation]:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rce_fleet.station"),
        *("--ros-master", master, "--port", "0", "--state-dir", str(folder)),
        stdout=asyncio.subprocess.PIPE,
        env=os.environ,
    )
    try:
        assert process.stdout is not None
        async with asyncio.timeout(LIMIT_S):
            words = (await process.stdout.readline()).decode()
        async with ClientSession() as browser:
            yield RunningStation(process, words.removeprefix("rce ui ready: ").strip(), browser)
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


async def test_a_driven_robot_gets_its_mode_back_when_the_station_ends(tmp_path: Path) -> None:
    """Before the program has ended; after a crash, once it runs again. What was recorded is there then."""
    async with planner() as (master, fleet):
        async with station(master, tmp_path) as running, running.driving():
            first = await running.recorded()
            await running.end(signal.SIGKILL)
            assert fleet.mode == "manual"
        async with station(master, tmp_path) as running:
            await fleet.until("paused")
            assert await running.recorded() == first
            async with running.driving():
                await fleet.until("manual")
                await running.end(signal.SIGTERM)
                assert (fleet.mode, running.process.returncode) == ("paused", 0)


async def test_a_mode_that_the_planner_did_not_set_is_set_later(tmp_path: Path) -> None:
    async with planner() as (master, fleet), station(master, tmp_path) as running:
        async with running.driving():
            fleet.refuses = True
        async with asyncio.timeout(LIMIT_S):
            await fleet.refused.wait()
        (file,) = tmp_path.glob("modes-*.json")
        assert json.loads(file.read_bytes()) == {"Robot1": {"mode": "paused", "user": "operator"}}
        fleet.refuses = False
        await fleet.until("paused")
