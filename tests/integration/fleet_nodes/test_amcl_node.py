"""``amcl`` on a real core: topics, services, frames, and what it does with bad input."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from math import hypot, nan
from typing import Any

import numpy as np
import pytest
from support.simulated_scans import BEAMS, Robot, hall

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.tf import TransformListener
from rce.ros.types import Message, Time
from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.jumps import PAUSE_SHARE
from rce_fleet.geometry.poses import Pose
from rce_fleet.localization.parameters import LaserModel
from rce_fleet.nodes.amcl import AmclNode
from rce_fleet.nodes.amcl_parameters import AmclNodeParameters
from rce_fleet.nodes.kept_pose import StoredPose
from rce_fleet.nodes.map_messages import map_fields
from rce_fleet.nodes.parameters import read_parameters
from rce_fleet.nodes.planar import pose_fields, pose_of
from rce_fleet.nodes.pose_messages import pose_with_covariance_fields, read_pose_with_covariance

PATIENCE = 60.0
ORIGIN = Pose(0.0, 0.0, 0.0)
START = Pose(1.0, 1.0, 0.3)
SETTINGS = AmclNodeParameters(
    max_particles=1000,
    laser_max_beams=60,
    laser_model_type=LaserModel.LIKELIHOOD_FIELD_PROB,
    initial_pose_x=1.05,
    initial_pose_y=0.95,
    initial_pose_a=0.25,
    initial_cov_xx=0.03,
    initial_cov_yy=0.03,
    initial_cov_aa=0.02,
)


class World:
    """A core with amcl, a robot, and a judge who hears everything."""

    def __init__(self, core: Core, judge: Node, robot: Robot) -> None:
        self.core = core
        self.judge = judge
        self.robot = robot
        self.poses: list[Message] = []
        self.logs: list[tuple[int, str]] = []
        self.states: list[tuple[int, str]] = []
        self.changed = asyncio.Event()

    async def listen(self, stack: AsyncExitStack) -> None:
        def keep(into: list[Any], read: Callable[[Message], Any]) -> Callable[[Message], None]:
            def take(message: Message) -> None:
                into.append(read(message))
                self.changed.set()

            return take

        judge = self.judge
        pose = "geometry_msgs/PoseWithCovarianceStamped"
        await judge.subscribe("amcl_pose", pose, keep(self.poses, lambda m: m))
        await judge.subscribe("/rosout", "rosgraph_msgs/Log", keep(self.logs, lambda m: (m.level, m.msg)))
        await judge.subscribe(
            "/diagnostics",
            "diagnostic_msgs/DiagnosticArray",
            keep(self.states, lambda m: (m.status[0].level, m.status[0].message)),
        )
        self.tf = await stack.enter_async_context(TransformListener(judge))

    @asynccontextmanager
    async def amcl(self, settings: AmclNodeParameters | None = None) -> AsyncIterator[None]:
        """Run the node; without settings with the parameters that the master has."""
        async with Node("amcl", argv=[], master_uri=self.core.uri) as node:
            given = await read_parameters(node, AmclNodeParameters) if settings is None else settings
            running = asyncio.create_task(AmclNode(node, given, seed=1).run())
            try:
                yield
                assert not running.done()
            finally:
                node.shutdown("the test is over")
                await running

    async def ready(self) -> None:
        """Wait until the node has the map and hears scans."""
        await self.says("map of 100 x 80 cells")
        await self.until(lambda: self.robot._scans.connections)

    async def first_pose(self) -> Message:
        """Return what a node that was started again finds with one scan."""
        await self.until(lambda: sum("map of 100" in text for _, text in self.logs) == 2)
        await self.until(lambda: self.robot._scans.connections)
        return await self.pose_at(self.robot.publish())

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not condition():
                self.changed.clear()
                await self.changed.wait()

    async def says(self, text: str) -> None:
        await self.until(lambda: any(text in line for _, line in self.logs))

    async def pose_at(self, stamp: Time) -> Message:
        await self.until(lambda: any(each.header.stamp == stamp for each in self.poses))
        return next(each for each in self.poses if each.header.stamp == stamp)

    async def drive(self, steps: int) -> Message:
        """Drive in steps that each cause an update; return the last pose."""
        found = None
        for _ in range(steps):
            self.robot.drive(0.21, 0.12)
            found = await self.pose_at(self.robot.publish())
        assert found is not None
        return found

    def error(self, message: Message) -> tuple[float, float]:
        pose, _ = read_pose_with_covariance(message.pose)
        truth = self.robot.pose
        return hypot(pose.x - truth.x, pose.y - truth.y), abs(wrap(pose.yaw - truth.yaw))


@asynccontextmanager
async def graph(*, with_map: bool = True) -> AsyncIterator[World]:
    """Run everything but the node itself."""
    async with AsyncExitStack() as stack:
        core = await stack.enter_async_context(Core(port=0))

        async def node(name: str) -> Node:
            return await stack.enter_async_context(Node(name, argv=[], master_uri=core.uri))

        judge, source = await node("judge"), await node("robot")
        robot = Robot(source, START)
        made = World(core, judge, robot)
        await made.listen(stack)
        if with_map:
            fields = map_fields(hall(), "map", Time(1, 0))
            await source.advertise_service("static_map", "nav_msgs/GetMap", lambda _: {"map": fields})
        await robot.start(stack)
        yield made


@asynccontextmanager
async def world(settings: AmclNodeParameters = SETTINGS, *, with_map: bool = True) -> AsyncIterator[World]:
    async with graph(with_map=with_map) as made, made.amcl(settings):
        if with_map:
            await made.ready()
        yield made


async def test_a_driving_robot_is_localized() -> None:
    async with world() as here:
        clouds = await here.judge.subscribe("particlecloud", "geometry_msgs/PoseArray")
        pose = await here.drive(8)
        away, turned = here.error(pose)
        assert away < 0.12
        assert turned < 0.06
        assert pose.header.frame_id == "map"
        tf = await here.tf.wait_for("map", "odom", timeout=PATIENCE)
        base = pose_of(tf.transform).compose(here.robot.odometry)
        assert hypot(base.x - here.robot.pose.x, base.y - here.robot.pose.y) < 0.15
        assert tf.stamp.to_sec() > pose.header.stamp.to_sec() + 0.09
        async with asyncio.timeout(PATIENCE):
            cloud = await anext(aiter(clouds))
        assert len(cloud.poses) >= 100
        await here.until(lambda: (0, "localized") in here.states)
        async with asyncio.timeout(PATIENCE):
            while await here.judge.get_param("/amcl/initial_pose_x", None) is None:
                await here.judge.sleep(0.2)


async def test_services_scatter_and_update_a_standing_robot() -> None:
    async with world() as here:
        await here.drive(2)
        update = here.judge.service_client("request_nomotion_update", "std_srvs/Empty")
        await update.call({}, timeout=PATIENCE)
        stood = await here.pose_at(here.robot.publish())
        _, before = read_pose_with_covariance(stood.pose)
        scatter = here.judge.service_client("global_localization", "std_srvs/Empty")
        await scatter.call({}, timeout=PATIENCE)
        clouds = await here.judge.subscribe("particlecloud", "geometry_msgs/PoseArray")
        async with asyncio.timeout(PATIENCE):
            cloud = await anext(aiter(clouds))
        spread = np.std([each.position.x for each in cloud.poses])
        assert spread > 1
        assert before[0, 0] < 0.05


async def test_the_cloud_is_there_before_the_robot_moves() -> None:
    """A page that shows it later gets it too."""
    async with world() as here:
        clouds = await here.judge.subscribe("particlecloud", "geometry_msgs/PoseArray")
        async with asyncio.timeout(PATIENCE):
            cloud = await anext(aiter(clouds))
        spread = np.std([each.position.x for each in cloud.poses])
        assert 0 < spread < 0.5


async def test_an_initial_pose_moves_the_particles() -> None:
    far = replace(SETTINGS, initial_pose_x=4.0, initial_pose_y=3.0)
    async with world(far) as here:
        await here.drive(1)
        starts = await here.judge.advertise("initialpose", "geometry_msgs/PoseWithCovarianceStamped")
        covariance = np.zeros((6, 6))
        covariance[0, 0] = covariance[1, 1] = covariance[5, 5] = 0.02
        pose = {"pose": pose_fields(here.robot.pose), "covariance": covariance.reshape(-1).tolist()}
        async with asyncio.timeout(PATIENCE):
            while not starts.connections:
                await asyncio.sleep(0.05)
        starts.publish(header={"frame_id": "odom"}, pose=pose)
        await here.says("initialpose is in frame 'odom', expected 'map': ignored")
        wrong = {"pose": pose_fields(Pose(nan, 0.0, 0.0)), "covariance": pose["covariance"]}
        starts.publish(header={"frame_id": "map"}, pose=wrong)
        await here.says("initialpose is ignored: the pose (nan")
        starts.publish(header={"frame_id": "map"}, pose=pose)
        await here.says("initial pose (1.")
        assert here.error(await here.drive(3))[0] < 0.15


async def test_another_map_by_topic_and_service() -> None:
    async with world(replace(SETTINGS, use_map_topic=True), with_map=False) as here:
        maps = await here.robot.node.advertise("map", "nav_msgs/OccupancyGrid", latch=True)
        broken = map_fields(hall(), "map", Time(1, 0))
        maps.publish(**(broken | {"data": np.zeros(7, np.int8)}))
        await here.says("the map cannot be used: a map of 100 x 80 cells came with 7 values")
        await here.until(lambda: any(level == 2 and "7 values" in text for level, text in here.states))
        maps.publish(**map_fields(hall(), "map", Time(1, 0)))
        await here.says("map of 100 x 80 cells")
        assert here.error(await here.drive(3))[0] < 0.15
        change = here.judge.service_client("set_map", "nav_msgs/SetMap")
        request = {
            "map": map_fields(hall(), "map", Time(2, 0)),
            "initial_pose": {"header": {"frame_id": "map"}, "pose": {"pose": pose_fields(here.robot.pose)}},
        }
        assert (await change.call(request, timeout=PATIENCE)).success
        request["map"] = {}
        assert not (await change.call(request, timeout=PATIENCE)).success
        assert here.error(await here.drive(2))[0] < 0.15


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"ranges": np.ones(7)}, f"it has 7 ranges; its angles are those of {BEAMS}"),
        ({"ranges": []}, "it has 0 ranges"),
        ({"angle_increment": 0.0}, "angle_increment must not be 0"),
        ({"angle_min": nan}, "must be finite"),
        ({"range_max": 0.0}, "range_max 0.0 m must be greater than range_min"),
        ({"header": {"frame_id": "nowhere"}}, "nowhere"),
    ],
)
async def test_a_faulty_scan_is_reported(changed: dict[str, Any], text: str) -> None:
    async with world() as here:
        here.robot.publish(**changed)
        await here.says(text)
        assert here.error(await here.drive(3))[0] < 0.15


async def test_scans_at_wrong_times_are_reported() -> None:
    async with world() as here:
        await here.drive(2)
        now = here.robot.node.now()
        here.robot.publish(Time(now.secs - 3, 0), transform=False)
        await here.says("s older than the last one")
        here.robot.publish(Time(now.secs + 500, 0), transform=False)
        await here.says("s in the future) cannot be used")
        await here.until(lambda: any("in the future" in text for _, text in here.states))
        assert here.error(await here.drive(3))[0] < 0.15


async def test_ranges_that_are_no_numbers_are_left_out() -> None:
    async with world() as here:
        await here.drive(2)
        here.robot.drive(0.21, 0.0)
        await here.pose_at(here.robot.publish(ranges=np.full(BEAMS, nan)))
        here.robot.drive(0.21, 0.0)
        await here.pose_at(here.robot.publish(ranges=np.full(BEAMS, np.inf)))
        assert here.error(await here.drive(4))[0] < 0.15


async def test_odometry_that_jumps_keeps_the_pose() -> None:
    async with world() as here:
        await here.drive(3)
        here.robot.odometry = Pose(-70.0, 30.0, 2.0)
        pose = await here.drive(1)
        await here.says("the odometry jumped")
        assert here.error(pose)[0] < 0.4
        assert here.error(await here.drive(8))[0] < 0.15


async def test_odometry_that_begins_anew_keeps_the_pose() -> None:
    """The robot's driver was restarted: its stamps say that the robot could have driven there meanwhile."""
    async with world() as here:
        here.robot.odometry = Pose(3.0, 2.0, 2.0)
        await here.drive(3)
        before, last = (each.header.stamp.to_sec() for each in here.poses[-2:])
        await here.judge.sleep(1.5 + PAUSE_SHARE * (last - before))
        here.robot.odometry = ORIGIN
        pose = await here.pose_at(here.robot.publish())
        await here.says("the odometry jumped to its origin")
        assert here.error(pose)[0] < 0.4
        assert here.error(await here.drive(8))[0] < 0.15


async def test_without_a_map_the_state_says_so() -> None:
    async with world(with_map=False) as here:
        await here.says("waiting for the map: service static_map")
        await here.until(lambda: (2, "waits for the map") in here.states)


async def test_last_pose_of_the_robot_counts_before_parameters() -> None:
    far = replace(SETTINGS, initial_pose_x=4.0, initial_pose_y=3.0, last_pose_timeout=1e6)
    async with graph() as here:
        pose = pose_with_covariance_fields(START, np.diag((0.02, 0.02, 0.02)))
        answer = {"known": True, "pose": {"header": {"frame_id": "map"}, "pose": pose}}
        await here.judge.advertise_service("last_pose", "fleet/GetLastPose", lambda _: answer)
        async with here.amcl(far):
            await here.says("initial pose (1.000, 1.000, 0.300)")
            await here.ready()
            assert here.error(await here.drive(2))[0] < 0.2


@asynccontextmanager
async def localized_before(*, odometry: Pose = ORIGIN) -> AsyncIterator[World]:
    """A robot whose localization stored a pose and died. A scan tells the next one next to nothing."""
    async with graph() as here:
        here.robot.odometry = odometry
        async with here.amcl(SETTINGS):
            await here.ready()
            pose = (await here.drive(6)).pose.pose.position
            async with asyncio.timeout(PATIENCE):
                while await here.judge.get_param("/amcl/initial_cov_aa", None) is None:
                    await here.judge.sleep(0.1)
                stored = await here.judge.get_param("/amcl/stored_pose")
                while StoredPose.from_json(stored).kept.pose.x != pose.x:
                    await here.judge.sleep(0.1)
                    stored = await here.judge.get_param("/amcl/stored_pose")
        await here.judge.set_param("/amcl/laser_likelihood_max_dist", 0.001)
        await here.judge.set_param("/amcl/laser_z_rand", 1e6)
        yield here


async def test_restarted_node_knows_how_the_robot_moved_meanwhile() -> None:
    """A robot that turns when its localization dies goes on turning."""
    async with localized_before() as here:
        here.robot.drive(0.5, 0.0)
        here.robot.drive(0.0, -1.6)
        async with here.amcl():
            away, turned = here.error(await here.first_pose())
        assert away < 0.15
        assert turned < 0.15


async def test_odometry_that_began_anew_does_not_move_the_stored_pose() -> None:
    async with localized_before(odometry=Pose(400.0, -300.0, 1.0)) as here:
        here.robot.odometry = ORIGIN
        async with here.amcl():
            away, turned = here.error(await here.first_pose())
        assert away < 0.15
        assert turned < 0.15


async def test_initial_pose_that_was_set_since_counts_before_the_stored_one() -> None:
    async with localized_before() as here:
        for axis, value in {"x": 3.0, "y": 2.5, "a": -2.0}.items():
            await here.judge.set_param(f"/amcl/initial_pose_{axis}", value)
        here.robot.pose = Pose(3.0, 2.5, -2.0)
        async with here.amcl():
            away, turned = here.error(await here.first_pose())
        assert away < 0.15
        assert turned < 0.15


async def test_damaged_stored_pose_is_told() -> None:
    async with localized_before() as here:
        await here.judge.set_param("/amcl/stored_pose", '{"pose": [1, 2, 3]}')
        async with here.amcl():
            await here.says("/amcl/stored_pose is not used: it has no usable 'odometry'")
            assert here.error(await here.first_pose())[0] < 0.15
