"""``pose_keeper`` on a real core: it knows where the robot is while its localization is away."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from math import nan
from pathlib import Path

import numpy as np
import pytest

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.tf import Transform, TransformBroadcaster
from rce.ros.types import Message, Time
from rce_fleet.geometry.poses import Pose
from rce_fleet.nodes.kept_pose import BOOT_ID, KeptPose, StoredPose, default_path, read_stored_pose
from rce_fleet.nodes.pose_keeper import PoseKeeper, PoseKeeperParameters, ask_for_last_pose
from rce_fleet.nodes.pose_messages import pose_with_covariance_fields, read_pose_with_covariance

PATIENCE = 60.0
EXACT = np.diag((0.01, 0.01, 0.01))


class Graph:
    """A core with a pose keeper, a localization and a robot; the test plays the latter two."""

    def __init__(self, node: Node, tf: TransformBroadcaster) -> None:
        self.node = node
        self.tf = tf

    async def start(self) -> None:
        kind = "geometry_msgs/PoseWithCovarianceStamped"
        self.poses = await self.node.advertise("amcl_pose", kind, latch=True)
        self.service = self.node.service_client("last_pose", "fleet/GetLastPose")
        async with asyncio.timeout(PATIENCE):
            await self.poses.wait_for_subscribers()
            await self.node.wait_for_service("last_pose")

    def localize(self, pose: Pose, odometry: Pose) -> None:
        """Publish a pose on the map, and the odometry of the same moment."""
        stamp = self.node.now()
        self.publish_odometry(odometry, stamp)
        made = pose_with_covariance_fields(pose, EXACT)
        self.poses.publish(header={"stamp": stamp, "frame_id": "map"}, pose=made)

    def publish_odometry(self, odometry: Pose, stamp: Time | None = None) -> None:
        at = Transform.make(odometry.x, odometry.y, yaw=odometry.yaw)
        self.tf.send("odom", "base_link", at, stamp or self.node.now())

    async def last_pose(self) -> Message:
        return await self.service.call({}, timeout=PATIENCE)

    async def says(self, expected: Pose) -> np.ndarray:
        """Wait until this pose is answered (messages of two topics have no order); return its covariance."""
        async with asyncio.timeout(PATIENCE):
            while True:
                answer = await self.last_pose()
                if answer.known:
                    pose, covariance = read_pose_with_covariance(answer.pose.pose)
                    if np.allclose(pose.as_array(), expected.as_array(), atol=1e-3):
                        assert answer.pose.header.frame_id == "map"
                        return covariance
                await asyncio.sleep(0.05)


@asynccontextmanager
async def graph(path: Path | None = None) -> AsyncIterator[Graph]:
    async with AsyncExitStack() as stack:
        core = await stack.enter_async_context(Core(port=0))
        judge, keeper = [
            await stack.enter_async_context(Node(name, argv=[], master_uri=core.uri, signals=False))
            for name in ("judge", "pose_keeper")
        ]
        parameters = PoseKeeperParameters(store=path is not None, pose_file=str(path or ""))
        running = asyncio.create_task(PoseKeeper(keeper, parameters).run())
        try:
            made = Graph(judge, await stack.enter_async_context(TransformBroadcaster(judge)))
            await made.start()
            yield made
            assert not running.done()
        finally:
            keeper.shutdown("the test is over")
            await running


async def test_last_pose_moves_on_with_the_odometry() -> None:
    async with graph() as here:
        assert not (await here.last_pose()).known
        here.localize(Pose(3.0, 4.0, np.pi / 2), Pose(1.0, 0.0, 0.0))
        narrow = await here.says(Pose(3.0, 4.0, np.pi / 2))
        here.publish_odometry(Pose(1.5, 0.0, 0.2))
        wide = await here.says(Pose(3.0, 4.5, np.pi / 2 + 0.2))
        assert wide[0, 0] > narrow[0, 0] > EXACT[0, 0]


async def test_last_pose_stays_when_the_odometry_jumps() -> None:
    async with graph() as here:
        here.localize(Pose(3.0, 4.0, 0.0), Pose(1.0, 0.0, 0.0))
        await here.says(Pose(3.0, 4.0, 0.0))
        here.publish_odometry(Pose(-90.0, 20.0, 1.0))
        await here.says(Pose(3.0, 4.0, 0.0))
        here.publish_odometry(Pose(-90.0, 20.0, 1.0).compose(Pose(0.25, 0.0, 0.0)))
        await here.says(Pose(3.25, 4.0, 0.0))


async def test_last_pose_outlives_a_restart(tmp_path: Path) -> None:
    """A pose keeper that is started again, and then a robot whose odometry begins anew, too."""
    path = tmp_path / "kept" / "pose.json"
    async with graph(path) as here:
        here.localize(Pose(3.0, 4.0, np.pi / 2), Pose(1.0, 0.0, 0.0))
        first = await here.says(Pose(3.0, 4.0, np.pi / 2))
    assert path.exists()
    async with graph(path) as here:
        here.publish_odometry(Pose(1.5, 0.0, 0.0))
        wider = await here.says(Pose(3.0, 4.5, np.pi / 2))
        assert wider[0, 0] >= first[0, 0] + 0.2**2
        here.localize(Pose(5.0, 4.0, 0.0), Pose(2.0, 0.0, 0.0))
        await here.says(Pose(5.0, 4.0, 0.0))
    async with graph(path) as here:
        here.publish_odometry(Pose(0.0, 0.0, 0.0))
        await here.says(Pose(5.0, 4.0, 0.0))
        here.publish_odometry(Pose(0.3, 0.0, 0.0))
        await here.says(Pose(5.3, 4.0, 0.0))


async def test_damaged_file_of_the_pose_is_told(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    path.write_text('{"pose": [1, 2]}')
    async with graph(path) as here:
        logs = await here.node.subscribe("/rosout", "rosgraph_msgs/Log")
        async with asyncio.timeout(PATIENCE):
            async for line in logs:
                if "the stored pose is not used" in line.msg and str(path) in line.msg:
                    break
        assert not (await here.last_pose()).known


def test_stored_pose_of_another_boot_stands() -> None:
    kept = KeptPose("map", Pose(1.0, 2.0, 0.0), EXACT, Pose(4.0, 0.0, 0.0))
    stored = StoredPose(kept, "one", 100.0)
    assert stored.resume(Pose(5.0, 0.0, 0.0), "one", 102.0).odometry == Pose(4.0, 0.0, 0.0)
    assert stored.resume(Pose(5.0, 0.0, 0.0), "two", 102.0).odometry == Pose(5.0, 0.0, 0.0)
    assert stored.resume(Pose(0.0, 0.0, 0.0), "one", 102.0).odometry == Pose(0.0, 0.0, 0.0)
    assert stored.resume(Pose(50.0, 0.0, 0.0), "one", 102.0).odometry == Pose(50.0, 0.0, 0.0)
    assert BOOT_ID.read_text()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "Expecting"),
        ("{}", "no usable 'pose'"),
        (
            '{"pose": [1], "odometry": [1, 2, 3], "covariance": [], "frame": "map", "boot": "", "time": 1}',
            "3 numbers",
        ),
        ("[]", "no usable"),
    ],
)
def test_unusable_file_of_a_pose_is_refused(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=expected):
        read_stored_pose(path)


def test_each_master_and_node_has_its_own_file(tmp_path: Path) -> None:
    home = {"ROS_HOME": str(tmp_path)}
    made = {
        default_path(uri, node, home)
        for uri in ("http://127.0.0.1:11311/", "http://127.0.0.1:11312/")
        for node in ("/pose_keeper", "/Robot1/pose_keeper")
    }
    assert len(made) == 4
    assert all(path.parent == tmp_path / "last_pose" for path in made)


async def test_pose_that_is_not_finite_is_not_kept() -> None:
    async with graph() as here:
        logs = await here.node.subscribe("/rosout", "rosgraph_msgs/Log")
        here.localize(Pose(3.0, 4.0, 0.0), Pose(0.0, 0.0, 0.0))
        await here.says(Pose(3.0, 4.0, 0.0))
        here.localize(Pose(nan, 4.0, 0.0), Pose(0.0, 0.0, 0.0))
        async with asyncio.timeout(PATIENCE):
            async for line in logs:
                if "a pose is not kept: the pose (nan" in line.msg:
                    break
        await here.says(Pose(3.0, 4.0, 0.0))


async def test_asking_gives_up_in_time_or_when_told() -> None:
    async with Core(port=0) as core, Node("amcl", argv=[], master_uri=core.uri, signals=False) as node:
        faults: list[str] = []

        def waits(fault: str) -> bool:
            faults.append(fault)
            return True

        async with asyncio.timeout(PATIENCE):
            assert await ask_for_last_pose(node, 0.7, waits) is None
            assert await ask_for_last_pose(node, 1e6, lambda _: False) is None
        assert len(faults) > 1
        assert "waiting for the robot's last pose: service /last_pose" in faults[0]


@pytest.mark.parametrize("known", [True, False])
async def test_asking_returns_what_the_robot_knows(known: bool) -> None:
    async with graph() as here:
        if known:
            here.localize(Pose(3.0, 4.0, 0.0), Pose(0.0, 0.0, 0.0))
            await here.says(Pose(3.0, 4.0, 0.0))
        async with asyncio.timeout(PATIENCE):
            found = await ask_for_last_pose(here.node, PATIENCE, lambda _: True)
        assert (found is not None) is known


def test_kept_pose_turns_with_the_map() -> None:
    kept = KeptPose("map", Pose(1.0, 2.0, np.pi), EXACT, Pose(5.0, 5.0, np.pi / 2))
    pose, covariance = kept.moved_on(Pose(5.0, 6.0, np.pi / 2), 0.1, 0.0)
    assert np.allclose(pose.as_array()[:2], (0.0, 2.0))
    assert np.allclose(np.diag(covariance), 0.02)
