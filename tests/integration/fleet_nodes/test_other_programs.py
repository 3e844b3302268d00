"""The planner beside programs of others: a move client written from the paper, and a second planner."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from contextlib import AsyncExitStack
from functools import partial
from math import hypot
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from support.resting_robot import PACKAGES, fleet_program

from rce.ros.core import Core
from rce.ros.node import Node, Publisher, RosError
from rce.ros.node.master import MasterClient
from rce.ros.types import Message, Time, TypeRegistry
from rce.ros.xmlrpc import RpcClient

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


class Judge:
    """A node that hears the log of all, and asks the planner that serves the fleet."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._heard: asyncio.Queue[str] = asyncio.Queue()
        self.stopped: list[str] = []
        """Robots that were told to stop."""

    @classmethod
    async def start(cls, stack: AsyncExitStack, core: Core) -> Judge:
        node = Node("judge", argv=[], master_uri=core.uri, types=TypeRegistry(PACKAGES))
        judge = cls(await stack.enter_async_context(node))
        await node.subscribe("/rosout", "rosgraph_msgs/Log", judge._take)
        return judge

    def _take(self, message: Message) -> None:
        self._heard.put_nowait(f"{message.name}: {message.msg}")

    async def hears(self, text: str) -> str:
        async with asyncio.timeout(90):
            while text not in (said := await self._heard.get()):
                pass
        return said

    async def planner_began(self) -> Any:
        """Return when the planner that answers began; one that has ended stays registered for a while."""
        async with asyncio.timeout(90):
            while True:
                try:
                    client = self._node.service_client("/fleet/get_state", "fleet/GetState", persistent=False)
                    return (await client.call({}, timeout=5.0)).state.started
                except RosError:
                    await asyncio.sleep(0.2)

    async def show_newer_planner(self, own: Time) -> None:
        """Be two robots, one of which gets the grid of a newer planner each time after the grid of this one.

        Args:
            own: When the planner of this ROS graph began.
        """
        node, reports = self._node, dict[str, Publisher]()
        fields: dict[str, Any] = {"state": "idle", "reached": -1, "target": -1}
        async with asyncio.timeout(90):
            for robot in ("Robot1", "Robot2"):
                await node.advertise(f"/{robot}/amcl_pose", "geometry_msgs/PoseWithCovarianceStamped")
                reports[robot] = await node.advertise(f"/{robot}/moveClient/status", "fleet/MoveStatus")
                lists = await node.subscribe(f"/{robot}/goalNodesList", "std_msgs/Int32MultiArray")
                take = partial(self._take_stop, robot)
                stops = await node.subscribe(f"/{robot}/cancelGoal", "std_msgs/Bool", take)
                await stops.wait_for_publishers()
                await lists.wait_for_publishers()
                while not reports[robot].connections:
                    await asyncio.sleep(0.05)
                reports[robot].publish(**fields, grid=own)
                label = (await anext(aiter(lists))).layout.dim[0].label
                revision = int(label.removeprefix("revision="))
                reports[robot].publish(**fields, grid=own, revision=revision)
            self.stopped.clear()
            for grid in (own, Time(own.secs + 100, 0)) * 2:
                reports["Robot1"].publish(**fields, grid=grid, revision=revision)

    def _take_stop(self, robot: str, message: Message) -> None:
        assert message.data
        self.stopped.append(robot)

    async def fill_backlog(self, service: str) -> None:
        """Connect to a hung program until it accepts no more connections."""
        async with RpcClient() as rpc:
            master = MasterClient(self._node.master_uri, self._node.name, self._node.uri, rpc)
            place = urlsplit(str(await master.call("lookupService", service)))
        with contextlib.suppress(TimeoutError):
            while True:
                async with asyncio.timeout(1):
                    _, writer = await asyncio.open_connection(place.hostname, place.port)
                writer.close()


def _continue(process: asyncio.subprocess.Process) -> None:
    """Let a stopped process go on, unless it has ended."""
    if process.returncode is None:
        process.send_signal(signal.SIGCONT)


async def test_a_second_planner_stands_by_until_the_first_ends() -> None:
    """Of two planners in two ROS graphs, the older one stops, with the robots that it alone drives."""
    async with Core(port=0) as core, AsyncExitStack() as stack:
        judge = await Judge.start(stack, core)
        first = await stack.enter_async_context(fleet_program(core, "fleet_planner.py"))
        before = await judge.planner_began()
        await stack.enter_async_context(fleet_program(core, "fleet_planner.py", "__name:=spare"))
        await judge.hears("this one stands by")
        assert await judge.planner_began() == before
        first.kill()
        await judge.hears("this one takes over")
        began = await judge.planner_began()
        assert began != before
        await judge.show_newer_planner(began)
        said = await judge.hears("/spare: another planner, in another ROS graph, drives Robot1 too")
        assert "this planner has stopped; end one of the two" in said
        async with asyncio.timeout(60):
            while "Robot2" not in judge.stopped:
                await asyncio.sleep(0.05)


async def test_a_planner_that_was_hung_leaves_the_fleet_to_its_successor() -> None:
    """A hung program accepts connections, until its backlog is full: then it counts as ended."""
    async with Core(port=0) as core, AsyncExitStack() as stack:
        judge = await Judge.start(stack, core)
        first = await stack.enter_async_context(fleet_program(core, "fleet_planner.py", "__name:=first"))
        await judge.planner_began()
        first.send_signal(signal.SIGSTOP)
        stack.callback(_continue, first)
        await stack.enter_async_context(fleet_program(core, "fleet_planner.py", "__name:=spare"))
        await judge.hears("/spare: the other planner (/fleet/set_goal at ")
        await judge.hears("/spare: another planner serves this fleet")
        await judge.fill_backlog("/fleet/set_goal")
        await judge.hears("/spare: the other planner has ended: this one takes over")
        after = await judge.planner_began()
        first.send_signal(signal.SIGCONT)
        await judge.hears(
            "/first: the planner /spare has taken over this fleet: this one stops, and stands by"
        )
        await judge.hears("/first: another planner serves this fleet")
        assert await judge.planner_began() == after


async def test_a_hung_planner_is_given_up_after_a_while() -> None:
    """Its kernel accepts connections, as long as it is stopped."""
    async with Core(port=0) as core, AsyncExitStack() as stack:
        judge = await Judge.start(stack, core)
        first = await stack.enter_async_context(fleet_program(core, "fleet_planner.py", "__name:=first"))
        before = await judge.planner_began()
        first.send_signal(signal.SIGSTOP)
        stack.callback(_continue, first)
        await stack.enter_async_context(fleet_program(core, "fleet_planner.py", "__name:=spare"))
        await judge.hears("accepts connections and does not answer: this one takes over in 30 s")
        await judge.hears("/spare: the other planner has not answered for 30 s: this one takes over")
        after = await judge.planner_began()
        assert after != before
        first.send_signal(signal.SIGCONT)
        await judge.hears("/first: another planner serves this fleet")
        assert await judge.planner_began() == after


async def test_a_second_manager_stands_by_until_the_first_ends(tmp_path: Path) -> None:
    """Each would send the robots to its own goals, and hold the tasks of the other."""
    async with Core(port=0) as core, AsyncExitStack() as stack:
        judge = await Judge.start(stack, core)
        programs = {}
        for name in ("one", "two"):
            arguments = f"__name:={name}", f"_journal:={tmp_path / name}.sqlite"
            program = fleet_program(core, "fleet_manager.py", *arguments)
            programs[f"/{name}"] = await stack.enter_async_context(program)
        said = await judge.hears("another fleet manager serves this fleet (/fleet/request")
        del programs[said.partition(":")[0]]
        for first in programs.values():
            first.kill()
        await judge.hears("the other fleet manager has ended: this one opens its journal")
        await judge.hears("the fleet manager has 0 open tasks")


async def test_a_hung_manager_with_the_same_journal_is_named(tmp_path: Path) -> None:
    """It keeps its journal: the second one says which program people have to end."""
    async with Core(port=0) as core, AsyncExitStack() as stack:
        judge = await Judge.start(stack, core)
        journal = f"_journal:={tmp_path / 'journal.sqlite'}"
        first = await stack.enter_async_context(
            fleet_program(core, "fleet_manager.py", "__name:=one", journal)
        )
        await judge.hears("/one: the fleet manager has 0 open tasks")
        first.send_signal(signal.SIGSTOP)
        stack.callback(_continue, first)
        second = await stack.enter_async_context(
            fleet_program(core, "fleet_manager.py", "__name:=two", journal)
        )
        await judge.hears("/two: the other fleet manager (/fleet/request at rosrpc://")
        await judge.fill_backlog("/fleet/request")
        await judge.hears("/two: the other fleet manager has ended: this one opens its journal")
        said = await judge.hears("/two: the fleet manager cannot start: ")
        assert "is used by another fleet manager; end it, or give another file" in said
        assert "It may be hung: /one at rosrpc://" in said
        async with asyncio.timeout(60):
            assert await second.wait() == 2


async def test_a_manager_without_its_journal_says_so(tmp_path: Path) -> None:
    kept = tmp_path / "journal.sqlite"
    kept.write_text("a letter")
    async with Core(port=0) as core:
        code, said = await ended(core, "fleet_manager.py", f"_journal:={kept}")
    assert code == 2
    assert f"fleet_manager: the journal {kept} cannot be opened: it is damaged" in said
    assert "Traceback" not in said


async def ended(core: Core, exe: str, *arguments: str) -> tuple[int | None, str]:
    """Run a node that cannot start; return its exit code and what it said."""
    process = await asyncio.create_subprocess_exec(
        *PACKAGES.find("fleet").executable(exe),
        *arguments,
        env={**os.environ, "ROS_MASTER_URI": core.uri},
        stderr=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    async with asyncio.timeout(60):
        out, err = await process.communicate()
    return process.returncode, (out + err).decode()


async def test_of_two_planners_that_start_together_one_stands_by() -> None:
    async with Core(port=0) as core, AsyncExitStack() as stack:
        judge = await Judge.start(stack, core)
        for name in ("one", "two"):
            await stack.enter_async_context(fleet_program(core, "fleet_planner.py", f"__name:={name}"))
        said = await judge.hears("another planner serves this fleet")
        began = await judge.planner_began()
        assert said.startswith(("/one", "/two"))
        assert await judge.planner_began() == began


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("_planner:=best",), "installed planners are"),
        (("_cell_size:=0.4",), "do not fit into cells of 0.4 m"),
    ],
)
async def test_a_planner_refuses_wrong_parameters(arguments: tuple[str, ...], text: str) -> None:
    async with Core(port=0) as core:
        code, said = await ended(core, "fleet_planner.py", *arguments)
    assert text in said
    assert code
