"""A simulated robot explores a floor with slam_gmapping, move_base, the safety stage and explore."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import AsyncExitStack, asynccontextmanager
from math import hypot
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from rce.ros.actions import ServerGoal, SimpleActionServer
from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.tf import StaticTransformBroadcaster, Transform
from rce.ros.types import Message, Time, TypeRegistry
from rce_fleet.drivers.program import RunOptions, Simulation
from rce_fleet.drivers.scene import RobotStart, Scene
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.agreement import compare_maps
from rce_fleet.maps.occupancy_map import UNKNOWN, OccupancyMap
from rce_fleet.navigation.safety.parameters import SafetyParameters
from rce_fleet.nodes import explore
from rce_fleet.nodes.explore import ExploreNode, ExploreParameters
from rce_fleet.nodes.map_messages import map_fields
from rce_fleet.nodes.move_base import MoveBaseNode
from rce_fleet.nodes.move_base_parameters import read_settings
from rce_fleet.nodes.parameter_values import read_values
from rce_fleet.nodes.planar import read_map
from rce_fleet.nodes.slam_gmapping import SlamGmappingNode, SlamGmappingParameters
from rce_fleet.nodes.velocity_limiter import VelocityLimiterNode

pytestmark = [pytest.mark.timeout(400), pytest.mark.needs("pymunk")]

PATIENCE = 180.0
FILES = Path(__file__).parents[3] / "configs" / "turtlebot"
START = Pose(0.5, 0.5, 0.6)
SCENE = Scene(
    rows=3,
    columns=3,
    walls=(4,),
    model="turtlebot2",
    stand_ins=False,
    robots=(RobotStart(id="Robot1", cell=0, yaw=START.yaw, sensor="lidar"),),
)


def read(name: str) -> dict[str, Any]:
    values = yaml.safe_load((FILES / name).read_text())
    assert isinstance(values, dict)
    return values


def mapping_parameters() -> SlamGmappingParameters:
    values = {**read("gmapping.yaml"), "particles": 5, "seed": 1}
    values["map_start_pose"] = [START.x, START.y, START.yaw]
    parameters, problems = read_values(SlamGmappingParameters, values)
    assert problems == []
    return parameters


def explore_parameters(**changes: Any) -> ExploreParameters:
    parameters, problems = read_values(ExploreParameters, {**read("explore.yaml"), **changes})
    assert problems == []
    return parameters


class Judge:
    """Hears what is published."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.maps: list[Message] = []
        self.statuses: list[str] = []
        self.markers: list[Message] = []
        self.states: list[str] = []

    async def listen(self) -> None:
        node = self.node
        await node.subscribe("map", "nav_msgs/OccupancyGrid", self.maps.append)
        await node.subscribe("explore/status", "std_msgs/String", lambda m: self.statuses.append(m.data))
        await node.subscribe("explore/frontiers", "visualization_msgs/MarkerArray", self.markers.append)
        await node.subscribe("/diagnostics", "diagnostic_msgs/DiagnosticArray", self._take_state)

    def _take_state(self, message: Message) -> None:
        self.states += [status.message for status in message.status if "exploration" in status.name]

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not condition():
                await asyncio.sleep(0.05)


class Parts:
    """Nodes beside a test; they end with the stack."""

    def __init__(self, stack: AsyncExitStack, uri: str = "") -> None:
        self.stack = stack
        self.uri = uri

    async def node(self, name: str, *remappings: str) -> Node:
        node = Node(name, argv=list(remappings), master_uri=self.uri, signals=False)
        return await self.stack.enter_async_context(node)

    def run(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)

        async def end() -> None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

        self.stack.push_async_callback(end)

    async def simulate(self, scene: Scene) -> Simulation:
        """Run a world with one robot, whose graph the nodes join; its time is simulated."""
        said: asyncio.Queue[str] = asyncio.Queue()
        options = RunOptions(clock=True)
        simulation = Simulation(scene, TypeRegistry(), said.put_nowait, options=options)
        self.run(simulation.run(asyncio.Event()))
        async with asyncio.timeout(PATIENCE):
            while not self.uri:
                _, _, self.uri = (await said.get()).partition("ROS_MASTER_URI=")
        return simulation


@pytest.fixture
async def parts() -> AsyncIterator[Parts]:
    async with AsyncExitStack() as stack:
        yield Parts(stack)


async def test_a_robot_maps_its_floor_and_returns(parts: Parts, caplog: pytest.LogCaptureFixture) -> None:
    """The map agrees with the true walls, nothing was touched, and the robot is back where it started."""
    world = (await parts.simulate(SCENE)).world
    robot = world.robots["Robot1"]
    judge = Judge(await parts.node("judge"))
    await judge.listen()
    parts.run(SlamGmappingNode(await parts.node("slam_gmapping"), mapping_parameters()).run())
    parts.run(VelocityLimiterNode(await parts.node("velocity_limiter"), SafetyParameters()).run())
    settings, problems = read_settings(read("move_base.yaml"))
    assert problems == []
    parts.run(MoveBaseNode(await parts.node("move_base", "cmd_vel:=raw_cmd_vel"), settings).run())
    parts.run(ExploreNode(await parts.node("explore"), explore_parameters()).run())
    await judge.until(lambda: explore.RETURNED in judge.statuses)
    agreement = compare_maps(read_map(judge.maps[-1]), SCENE.draw())
    assert agreement.explored > 0.97, agreement
    assert agreement.right > 0.97, agreement
    assert agreement.wall_error_m < 0.05, agreement
    assert world.collisions.own_motion == 0
    assert robot.distance > 2.0
    assert hypot(robot.pose.x - START.x, robot.pose.y - START.y) < 0.35
    assert explore.IN_PROGRESS in judge.statuses
    known = [int((np.asarray(message.data) >= 0).sum()) for message in judge.maps]
    assert known[0] < known[-1], "it grew"
    assert max(len(message.markers) for message in judge.markers) > 2
    assert "the floor is explored" in caplog.text


# Beside an action server of the test


def half_hall(known: int) -> OccupancyMap:
    """Return a hall of 4 x 1.8 m, of which so many columns of 0.1 m are known."""
    data = np.full((20, 42), UNKNOWN, np.int8)
    data[:, :known] = 0
    data[[0, -1], :known] = 100
    data[:, 0] = 100
    if known == data.shape[1]:
        data[:, -1] = 100
    return OccupancyMap(data, 0.1)


class Scripted:
    """The node beside an action server that does what a test says.

    Attributes:
        goals: Places of the goals that came, metres.
        answer: What is done with a goal.
    """

    def __init__(self) -> None:
        self.goals: list[tuple[float, float]] = []
        self.answer: Callable[[ServerGoal], Awaitable[None]] = never

    @asynccontextmanager
    async def beside(self, parts: Parts, core: Core, **changes: Any) -> AsyncIterator[Judge]:
        """Run the node; yield a judge who can publish maps."""
        parts.uri = core.uri
        node = await parts.node("server")
        judge = Judge(node)
        await judge.listen()
        self.maps = await node.advertise("map", "nav_msgs/OccupancyGrid", latch=True)
        self.resume = await node.advertise("explore/resume", "std_msgs/Bool")
        async with (
            StaticTransformBroadcaster(node) as frames,
            SimpleActionServer(node, "move_base", "move_base_msgs/MoveBaseAction", self._take),
        ):
            frames.send("map", "base_link", Transform.make(1.0, 1.0))
            explorer = await parts.node("explore")
            parts.run(ExploreNode(explorer, explore_parameters(planner_frequency=10.0, **changes)).run())
            await self.resume.wait_for_subscribers()
            yield judge

    def show(self, picture: OccupancyMap) -> None:
        self.maps.publish(**map_fields(picture, "map", Time.now()))

    async def _take(self, goal: ServerGoal) -> None:
        place = goal.request.target_pose.pose.position
        self.goals.append((place.x, place.y))
        await self.answer(goal)


async def never(goal: ServerGoal) -> None:
    """Drive until the goal is cancelled."""
    await goal.wait_for_cancel()


async def refuse(goal: ServerGoal) -> None:
    goal.abort("no way")


async def arrive(goal: ServerGoal) -> None:
    goal.succeed()


async def test_a_growing_map_moves_the_goal_until_all_is_known(parts: Parts) -> None:
    script = Scripted()
    async with Core(port=0) as core, script.beside(parts, core) as judge:
        script.show(half_hall(20))
        await judge.until(lambda: script.goals)
        assert script.goals[0][0] == pytest.approx(1.95, abs=0.1)
        script.show(half_hall(35))
        await judge.until(lambda: len(script.goals) == 2)
        assert script.goals[1][0] == pytest.approx(3.45, abs=0.1)
        script.answer = arrive
        script.show(half_hall(42))
        await judge.until(lambda: explore.RETURNED in judge.statuses)
        assert script.goals[2] == pytest.approx((1.0, 1.0))


async def test_refused_goals_are_given_up(parts: Parts, caplog: pytest.LogCaptureFixture) -> None:
    script = Scripted()
    script.answer = refuse
    async with Core(port=0) as core, script.beside(parts, core, return_to_init=False) as judge:
        script.show(half_hall(20))
        await judge.until(lambda: len(script.goals) == 1)
        await judge.until(lambda: "a frontier is given up: no way" in caplog.text)
        script.show(half_hall(20))  # a map newer than the failure
        await judge.until(lambda: explore.COMPLETE in judge.statuses)
        assert len(script.goals) == 1


async def test_pausing_stops_the_robot_until_it_is_resumed(parts: Parts) -> None:
    script = Scripted()
    async with Core(port=0) as core, script.beside(parts, core) as judge:
        script.show(half_hall(20))
        await judge.until(lambda: script.goals)
        script.resume.publish(data=False)
        await judge.until(lambda: explore.PAUSED in judge.statuses)
        script.show(half_hall(35))
        script.resume.publish(data=True)
        await judge.until(lambda: len(script.goals) == 2)


async def test_a_goal_that_others_cancel_pauses(parts: Parts, caplog: pytest.LogCaptureFixture) -> None:
    """The operator has the robot: exploration does not fight for it."""
    script = Scripted()
    async with Core(port=0) as core, script.beside(parts, core) as judge:
        cancel = await judge.node.advertise("move_base/cancel", "actionlib_msgs/GoalID")
        script.show(half_hall(20))
        await judge.until(lambda: script.goals)
        await cancel.wait_for_subscribers()
        cancel.publish()
        await judge.until(lambda: explore.PAUSED in judge.statuses)
        await judge.until(lambda: "publish true on /explore/resume" in caplog.text)


async def test_node_that_waits_for_move_base_ends_when_told(parts: Parts) -> None:
    async with Core(port=0) as core, asyncio.TaskGroup() as tasks:
        parts.uri = core.uri
        judge = Judge(await parts.node("judge"))
        await judge.listen()
        maps = await judge.node.advertise("map", "nav_msgs/OccupancyGrid", latch=True)
        async with StaticTransformBroadcaster(judge.node) as frames:
            frames.send("map", "base_link", Transform.make(1.0, 1.0))
            explorer = await parts.node("explore")
            running = tasks.create_task(
                ExploreNode(explorer, explore_parameters(planner_frequency=10.0)).run()
            )
            maps.publish(**map_fields(half_hall(20), "map", Time.now()))
            await judge.until(lambda: explore.IN_PROGRESS in judge.statuses)
            explorer.shutdown("the test says so")
            async with asyncio.timeout(30):
                await running


async def test_bad_maps_are_told_and_the_node_lives(parts: Parts, caplog: pytest.LogCaptureFixture) -> None:
    script = Scripted()
    async with Core(port=0) as core, script.beside(parts, core) as judge:
        await judge.until(lambda: any("waiting for the map on /map" in text for text in judge.states))
        fields = map_fields(half_hall(20), "map", Time.now())
        script.maps.publish(**{**fields, "data": fields["data"][:7]})
        await judge.until(lambda: "came with 7 values" in caplog.text)
        updates = await judge.node.advertise("map_updates", "map_msgs/OccupancyGridUpdate")
        await updates.wait_for_subscribers()
        far = np.full((5, 5), 100, np.int8)
        script.show(OccupancyMap(half_hall(20).data, 0.1, Pose(50.0, 0.0, 0.0)))
        await judge.until(lambda: any("is off the map" in text for text in judge.states))
        updates.publish(x=100, y=0, width=5, height=5, data=far.reshape(-1).tolist())
        await judge.until(lambda: "lies outside of the map" in caplog.text)
        assert script.goals == []
        script.show(half_hall(20))
        await judge.until(lambda: script.goals)
        strip = np.zeros((18, 15), np.int8)
        updates.publish(x=20, y=1, width=15, height=18, data=strip.reshape(-1).tolist())
        await judge.until(lambda: len(script.goals) == 2)
        assert script.goals[1][0] > 2.5
