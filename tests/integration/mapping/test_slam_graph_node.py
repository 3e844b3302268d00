"""The node slam_graph on a real core, with scans of two robots in a world of walls."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import numpy as np
from support.walls import box, drive, polyline, scan_at, wrong_odometry

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.tf import Transform, TransformBroadcaster, TransformListener
from rce_fleet.geometry.angles import quaternion_z
from rce_fleet.geometry.poses import compose, inverse, relative
from rce_fleet.mapping.graph.storage import load_graph
from rce_fleet.nodes.parameters import read_parameters
from rce_fleet.nodes.planar import read_map
from rce_fleet.nodes.slam_graph import SlamGraphNode
from rce_fleet.nodes.slam_graph_parameters import GMAPPING_ONLY, SlamGraphParameters

if TYPE_CHECKING:
    from pathlib import Path

    from support.walls import Poses

    from rce.ros.types import Message

LIMIT = 120
HALL = [
    *polyline((0, 0), (9, 0), (9, 4), (12, 4), (12, 8), (3, 8), (3, 6), (0, 6), closed=True),
    *box(4, 2.5, 1.5, 1.0),
    *box(8, 6.5, 0.6, 0.6),
    *box(1.0, 4.8, 0.4, 0.7),
]
ONE = drive([(1.5, 1.5), (7.5, 1.2), (7.6, 4.8)], step=0.25)
TWO = drive([(10.5, 5.2), (6.0, 5.2), (2.2, 4.2), (2.0, 1.6), (4.5, 1.4)], step=0.25)


class Robot:
    """Publishes a robot's scans and odometry, by transforms or by topic."""

    def __init__(self, node: Node, name: str, truth: Poses, seed: int) -> None:
        self.node, self.name, self.truth = node, name, truth
        self.rng = np.random.default_rng(seed)
        self.odometry = wrong_odometry(truth, self.rng)
        self.prefix = f"/{name}/" if name else "/"
        self.frame = f"{name}/" if name else ""

    async def start(self, broadcaster: TransformBroadcaster | None = None) -> None:
        self.broadcaster = broadcaster
        self.scans = await self.node.advertise(f"{self.prefix}scan", "sensor_msgs/LaserScan")
        if broadcaster is None:
            self.odometries = await self.node.advertise(f"{self.prefix}odom", "nav_msgs/Odometry")

    def is_heard(self) -> bool:
        return bool(self.scans.connections and (self.broadcaster or self.odometries.connections))

    def send(self, step: int, **changes: Any) -> None:
        stamp = self.node.now()
        x, y, yaw = (float(value) for value in self.odometry[step])
        if self.broadcaster is not None:
            base = f"{self.frame}base_link"
            self.broadcaster.send(f"{self.frame}odom", base, Transform.make(x, y, yaw=yaw), stamp)
            self.broadcaster.send(base, f"{self.frame}laser", Transform.make(0.1), stamp)
        else:
            z, w = quaternion_z(yaw)
            pose = {"position": {"x": x, "y": y}, "orientation": {"z": z, "w": w}}
            self.odometries.publish(header={"stamp": stamp}, pose={"pose": pose})
        laser = compose(self.truth[step], (0.1 if self.broadcaster else 0.0, 0.0, 0.0))
        record = scan_at(HALL, laser, beams=271, field_of_view=4.7, farthest=10.0, noise=0.01, rng=self.rng)
        fields = {
            "header": {"stamp": stamp, "frame_id": f"{self.frame}laser"},
            "angle_min": record.angle_min,
            "angle_max": -record.angle_min,
            "angle_increment": record.angle_increment,
            "range_min": 0.05,
            "range_max": 10.0,
            "ranges": record.ranges.tolist(),
        }
        self.scans.publish(**{**fields, **changes})


class World:
    """A core, the node under test and a judge who sees what it publishes."""

    def __init__(self, stack: AsyncExitStack) -> None:
        self.stack = stack
        self.heard: list[str] = []
        self.maps: list[Message] = []
        self.states: list[Message] = []

    async def start(self, values: dict[str, Any]) -> None:
        core = await self.stack.enter_async_context(Core(port=0))
        self.judge = await self.stack.enter_async_context(Node("judge", argv=[], master_uri=core.uri))
        await self.judge.set_param("/slam_graph", {"map_update_interval": 0.5, **values})
        await self.judge.subscribe("/rosout", "rosgraph_msgs/Log", lambda log: self.heard.append(log.msg))
        await self.judge.subscribe("/map", "nav_msgs/OccupancyGrid", self.maps.append)
        await self.judge.subscribe("/diagnostics", "diagnostic_msgs/DiagnosticArray", self.states.append)
        self.listener = await self.stack.enter_async_context(TransformListener(self.judge))
        node = Node("slam_graph", argv=[], master_uri=core.uri)
        self.node = await self.stack.enter_async_context(node)
        parameters = await read_parameters(self.node, SlamGraphParameters, unused=GMAPPING_ONLY)
        self.slam = SlamGraphNode(self.node, parameters)
        task = asyncio.create_task(self.slam.run())

        async def end() -> None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

        self.stack.push_async_callback(end)
        await self.judge.wait_for_service("/slam_graph/save_map", timeout=LIMIT)

    async def until(self, condition: Any) -> None:
        async with asyncio.timeout(LIMIT):
            while not condition():
                await asyncio.sleep(0.02)

    async def drive(self, *robots: Robot) -> None:
        """Send all scans, each when the one before it is mapped, so that none is dropped."""
        for robot in robots:
            await self.until(robot.is_heard)
        for step in range(max(len(robot.truth) for robot in robots)):
            sent = [robot for robot in robots if step < len(robot.truth)]
            for robot in sent:
                robot.send(step)
            for robot in sent:
                await self.until(lambda robot=robot, step=step: self.mapped(robot) > step)

    def mapped(self, robot: Robot) -> int:
        return self.slam.mapped.get(robot.name, 0)

    async def call(self, service: str, kind: str = "std_srvs/Trigger") -> Message:
        return await asyncio.wait_for(self.judge.service_client(service, kind).call({}), LIMIT)

    async def error_of(self, robot: Robot, origin: Poses) -> float:
        """Return how far the published transform puts a robot's last pose from the truth, metres."""
        frame = f"{robot.frame}odom"
        async with asyncio.timeout(LIMIT):
            while True:
                found = (await self.listener.wait_for("map", frame, timeout=LIMIT)).transform
                at = (found.translation.x, found.translation.y, found.yaw)
                pose = compose(at, robot.odometry[-1])
                error = relative(relative(origin, robot.truth[-1]), pose)
                if np.hypot(*error[:2]) < 0.1:
                    return float(np.hypot(*error[:2]))
                await asyncio.sleep(0.2)


async def test_one_robot_is_mapped_by_transforms(tmp_path: Path) -> None:
    async with AsyncExitStack() as stack:
        world = World(stack)
        await world.start({"map_file": str(tmp_path / "hall.npz"), "linearUpdat": 1.0, "particles": 30})
        broadcaster = await stack.enter_async_context(TransformBroadcaster(world.judge))
        robot = Robot(world.judge, "", ONE, 1)
        await robot.start(broadcaster)
        await world.drive(robot)
        assert await world.error_of(robot, ONE[0]) < 0.1
        answer = await world.call("/dynamic_map", "nav_msgs/GetMap")
        grid = read_map(answer.map)
        assert answer.map.header.frame_id == "map"
        wall = compose(inverse(ONE[0]), (3.0, 0.0, 0.0))
        row, column = grid.world_to_cell(wall[:2])
        assert grid.data[row - 2 : row + 3, column].max() == 100
        assert grid.data[tuple(grid.world_to_cell((1.0, 0.0)))] == 0
        await world.until(lambda: world.maps)
        saved = await world.call("/slam_graph/save_map")
        assert saved.success, saved.message
        assert (tmp_path / "hall.npz").exists()
        assert any("did you mean /slam_graph/linearUpdate" in text for text in world.heard)
        assert any("particles has no effect" in text for text in world.heard)


async def test_two_robots_get_one_map() -> None:
    async with AsyncExitStack() as stack:
        world = World(stack)
        await world.start({"robots": ["Robot1", "Robot2"], "use_odom_topic": True})
        robots = Robot(world.judge, "Robot1", ONE, 1), Robot(world.judge, "Robot2", TWO, 2)
        for robot in robots:
            await robot.start()
        await world.drive(*robots)
        for robot in robots:
            assert await world.error_of(robot, ONE[0]) < 0.1


async def test_bad_input_is_told_and_the_node_lives() -> None:
    async with AsyncExitStack() as stack:
        world = World(stack)
        await world.start({"use_odom_topic": True, "map_file": "/nowhere/map.npz", "load_map": True})
        robot = Robot(world.judge, "", ONE, 1)
        await robot.start()
        await world.until(robot.is_heard)
        await world.until(lambda: any("/nowhere/map.npz: cannot be read" in text for text in world.heard))
        robot.send(0, ranges=[1.0] * 7)
        await world.until(lambda: any("it has 7 ranges" in text for text in world.heard))
        robot.send(0, ranges=[float("nan")] * 271)
        await world.until(lambda: world.mapped(robot) == 1)
        robot.odometry[1] = (np.nan, 0.0, 0.0)
        robot.send(1)
        await world.until(lambda: any("numbers that are not finite" in text for text in world.heard))
        answer = await world.call("/slam_graph/save_map")
        assert not answer.success
        assert "cannot be written" in answer.message
        robot.odometry[2] = (0.1, 0.0, 0.0)
        robot.send(2)
        await world.until(lambda: world.mapped(robot) >= 2)
        robot.odometry[3] = (500.0, 0.0, 0.0)
        robot.send(3)
        await world.until(lambda: any("the odometry jumped" in text for text in world.heard))
        await world.until(
            lambda: any("mapping" in status.name for state in world.states for status in state.status)
        )


async def saved_map(values: dict[str, Any]) -> str:
    """Map by a node of these parameters, and save the map; return what the node answered."""
    async with AsyncExitStack() as stack:
        world = World(stack)
        await world.start(values)
        robot = Robot(world.judge, "", ONE, 1)
        await robot.start()
        await world.drive(robot)
        return str((await world.call("/slam_graph/save_map")).message)


async def test_a_saved_map_is_loaded_again(tmp_path: Path) -> None:
    """The map of one run: the next one localizes in it and leaves it as it is, or loads it on request."""
    values: dict[str, Any] = {"map_file": str(tmp_path / "hall.npz"), "use_odom_topic": True}
    saved = await saved_map(values)
    assert "keyscans to" in saved
    async with AsyncExitStack() as stack:
        world = World(stack)
        await world.start({**values, "localize_only": True, "initial_pose": [0.0, 0.0, 0.0]})
        robot = Robot(world.judge, "", ONE, 3)
        await robot.start()
        await world.drive(robot)
        assert await world.error_of(robot, ONE[0]) < 0.1
        assert (await world.call("/slam_graph/save_map")).message == saved
    async with AsyncExitStack() as stack:
        world = World(stack)
        await world.start(values)
        assert not world.maps
        loaded = await world.call("/slam_graph/load_map")
        assert loaded.success, loaded.message
        assert loaded.message.split()[1] == saved.split()[1]  # so many keyscans
        await world.until(lambda: world.maps)
        wall = compose(inverse(ONE[0]), (3.0, 0.0, 0.0))
        grid = read_map(world.maps[-1])
        row, column = grid.world_to_cell(wall[:2])
        assert grid.data[row - 2 : row + 3, column].max() == 100


async def test_a_map_that_cannot_be_loaded_is_kept(tmp_path: Path) -> None:
    """A file that was cut short may be repaired by its owner: a new map does not replace it."""
    file = tmp_path / "hall.npz"
    file.write_bytes(b"PK half a map")
    values: dict[str, Any] = {"map_file": str(file), "use_odom_topic": True, "load_map": True}
    answer = await saved_map(values)
    assert f"the file that could not be loaded is {file}.unread now" in answer
    assert (tmp_path / "hall.npz.unread").read_bytes() == b"PK half a map"
    assert len(load_graph(file))


async def test_without_its_map_the_node_does_not_map(tmp_path: Path) -> None:
    """With localize_only it publishes nothing before the map is loaded, and does not change it then."""
    file, other = tmp_path / "hall.npz", tmp_path / "elsewhere.npz"
    values: dict[str, Any] = {"map_file": str(file), "use_odom_topic": True}
    saved = await saved_map(values)
    poses = load_graph(file).poses.copy()
    file.rename(other)
    async with AsyncExitStack() as stack:
        world = World(stack)
        await world.start({**values, "localize_only": True, "initial_pose": [0.0, 0.0, 0.0]})
        await world.until(lambda: any("nothing to localize in" in text for text in world.heard))
        robot = Robot(world.judge, "", ONE, 3)
        await robot.start()
        await world.drive(robot)
        assert not (await world.call("/dynamic_map", "nav_msgs/GetMap")).map.data
        assert not world.maps
        assert not world.slam._transforms
        refused = await world.call("/slam_graph/save_map")
        assert "no scans yet" in refused.message
        assert not file.exists()
        assert not (await world.call("/slam_graph/load_map")).success
        other.rename(file)
        assert (await world.call("/slam_graph/load_map")).success
        world.slam.mapped.clear()
        await world.drive(robot)
        assert await world.error_of(robot, ONE[0]) < 0.1
        await world.until(lambda: world.maps)
        assert (await world.call("/slam_graph/save_map")).message == saved
    assert np.array_equal(load_graph(file).poses, poses)


async def test_a_new_map_can_begin_at_a_given_pose() -> None:
    async with AsyncExitStack() as stack:
        world = World(stack)
        await world.start({"use_odom_topic": True, "initial_pose": [float(value) for value in ONE[0]]})
        robot = Robot(world.judge, "", ONE[:20], 1)
        await robot.start()
        await world.drive(robot)
        assert await world.error_of(robot, np.zeros(3)) < 0.1
        await world.until(lambda: world.maps)
        grid = read_map(world.maps[-1])
        assert grid.values_at(ONE[:20, :2]).max() == 0
