"""The planner beside programs of others: a move client written from the paper, and a second planner."""

from __future__ import annotations

import asyncio
import os
from contextlib import AsyncExitStack
from math import hypot

import pytest
from support.resting_robot import PACKAGES, fleet_program

from rce.ros.core import Core
from rce.ros.node import Node, Publisher
from rce.ros.types import Message, TypeRegistry

SPEED, STEP, POSE_EVERY = 1.0, 0.05, 0.2


class PaperRobot:
    """A robot with a move client that knows two topics: ``goalNodesList`` and ``cancelGoal``.

    It drives to the cells of its list one after another, on a floor of 8 columns with cells of 1 m, and
    answers nothing. Its localization publishes a pose after each 0.2 m.
    """

    def __init__(self, node: Node, x: float, y: float) -> None:
        self.place = x, y
        self.been: list[int] = []
        self._node = node
        self._cells: list[int] = []
        self._poses: Publisher
        self._posed = x, y

    async def start(self) -> None:
        self._poses = await self._node.advertise(
            "amcl_pose", "geometry_msgs/PoseWithCovarianceStamped", latch=True
        )
        await self._node.subscribe("goalNodesList", "std_msgs/Int32MultiArray", self._take_cells)
        await self._node.subscribe("cancelGoal", "std_msgs/Bool", lambda _: self._cells.clear())
        self._publish()

    async def drive(self) -> None:
        while await self._node.sleep(STEP):
            if not self._cells:
                continue
            x, y = self._cells[0] % 8 + 0.5, self._cells[0] // 8 + 0.5
            away = hypot(x - self.place[0], y - self.place[1])
            share = min(SPEED * STEP / away, 1.0) if away else 1.0
            self.place = (
                self.place[0] + share * (x - self.place[0]),
                self.place[1] + share * (y - self.place[1]),
            )
            if share == 1.0:
                self.been.append(self._cells.pop(0))
            if hypot(self.place[0] - self._posed[0], self.place[1] - self._posed[1]) >= POSE_EVERY:
                self._publish()

    def _take_cells(self, message: Message) -> None:
        cells = list(message.data)
        here = int(self.place[1]) * 8 + int(self.place[0])
        self._cells = cells[cells.index(here) :] if here in cells else cells

    def _publish(self) -> None:
        self._posed = self.place
        position = {"x": self.place[0], "y": self.place[1]}
        self._poses.publish(
            header={"frame_id": "map"}, pose={"pose": {"position": position, "orientation": {"w": 1.0}}}
        )


async def test_a_move_client_of_the_paper_drives_to_its_goal() -> None:
    async with Core(port=0) as core, AsyncExitStack() as stack:
        planner = fleet_program(core, "fleet_planner.py", "_pose_only_after:=1.0")
        await stack.enter_async_context(planner)
        types = TypeRegistry(PACKAGES)
        made = Node("robot", namespace="Robot1", argv=[], master_uri=core.uri, types=types)
        node = await stack.enter_async_context(made)
        states: asyncio.Queue[Message] = asyncio.Queue()
        await node.subscribe("/fleet/state", "fleet/FleetState", states.put_nowait)
        robot = PaperRobot(node, 1.5, 2.5)
        await robot.start()
        tasks = await stack.enter_async_context(asyncio.TaskGroup())
        driving = tasks.create_task(robot.drive())
        stack.callback(driving.cancel)

        async def until(state: str) -> Message:
            found: list[Message] = []
            async with asyncio.timeout(60):
                while not found:
                    found = [robot for robot in (await states.get()).robots if robot.state == state]
            return found[0]

        assert (await until("idle")).pose_only
        async with asyncio.timeout(50):
            await node.wait_for_service("/fleet/set_goal")
            answer = await node.service_client("/fleet/set_goal", "fleet/SetGoal")(robot="Robot1", cell=30)
        assert answer.ok, answer.message
        assert (await until("arrived")).cell == 30
        assert robot.been[-1] == 30
        assert hypot(robot.place[0] - 6.5, robot.place[1] - 3.5) < 0.2


async def test_a_second_planner_stands_by_until_the_first_ends() -> None:
    async with Core(port=0) as core, AsyncExitStack() as stack:
        types = TypeRegistry(PACKAGES)
        node = Node("judge", argv=[], master_uri=core.uri, types=types)
        judge = await stack.enter_async_context(node)
        heard: asyncio.Queue[str] = asyncio.Queue()
        await judge.subscribe("/rosout", "rosgraph_msgs/Log", lambda message: heard.put_nowait(message.msg))

        async def hears(text: str) -> None:
            async with asyncio.timeout(60):
                while text not in await heard.get():
                    pass

        first = await stack.enter_async_context(fleet_program(core, "fleet_planner.py"))
        async with asyncio.timeout(60):
            await judge.wait_for_service("/fleet/get_state")
        before = await judge.service_client("/fleet/get_state", "fleet/GetState")()
        await stack.enter_async_context(fleet_program(core, "fleet_planner.py", "__name:=spare"))
        await hears("this one stands by")
        again = await judge.service_client("/fleet/get_state", "fleet/GetState")()
        assert again.state.started == before.state.started
        first.kill()
        await hears("this one takes over")
        async with asyncio.timeout(60):
            while True:
                try:
                    client = judge.service_client("/fleet/get_state", "fleet/GetState", persistent=False)
                    after = await client()
                    break
                except Exception:  # noqa: BLE001 - the registration of the killed planner is still there
                    await asyncio.sleep(0.2)
        assert after.state.started != before.state.started


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("_planner:=best",), "installed planners are"),
        (("_cell_size:=0.4",), "do not fit into cells of 0.4 m"),
    ],
)
async def test_a_planner_refuses_wrong_parameters(arguments: tuple[str, ...], text: str) -> None:
    async with Core(port=0) as core:
        command = PACKAGES.find("fleet").executable("fleet_planner.py")
        process = await asyncio.create_subprocess_exec(
            *command,
            *arguments,
            env={**os.environ, "ROS_MASTER_URI": core.uri},
            stderr=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
        )
        async with asyncio.timeout(60):
            out, err = await process.communicate()
        assert text in (out + err).decode()
        assert process.returncode
