"""Broadcasters and listeners between nodes: ours, and those of ROS's own tf2."""

from __future__ import annotations

import asyncio
import json
import logging
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from support.ros_nodes import MakeNode

from rce.ros.core import Core
from rce.ros.errors import NodeClosedError
from rce.ros.tf import (
    BadTransformError,
    ExtrapolationError,
    StampedTransform,
    StaticTransformBroadcaster,
    Transform,
    TransformBroadcaster,
    TransformListener,
    TransformTimeoutError,
)
from rce.ros.types import Time


def at(seconds: float) -> Time:
    return Time.from_sec(seconds)


def x_of(stamped: StampedTransform) -> float:
    return stamped.transform.translation.x


async def test_what_is_told_is_heard(make_node: MakeNode) -> None:
    async with (
        make_node("robot") as robot,
        make_node("planner") as planner,
        TransformBroadcaster(robot) as tf,
        StaticTransformBroadcaster(robot) as static,
        TransformListener(planner) as listener,
        asyncio.timeout(30),
    ):
        await tf._publisher.wait_for_subscribers()
        static.send("base", "laser", Transform.make(x=0.5))
        tf.send("odom", "base", Transform.make(x=1), at(10))
        tf.send("odom", "base", Transform.make(x=2), at(11))
        answer = await listener.wait_for("odom", "laser", at(10.5))
        assert x_of(answer) == pytest.approx(2.0)
        assert x_of(await listener.wait_for("odom", "laser", at(11))) == pytest.approx(2.5)
        assert x_of(listener.lookup("odom", "base")) == 2
        assert x_of(listener.lookup_full("base", at(11), "base", at(10), "odom")) == -1
        assert listener.can_transform("base", "odom")
        tf.send("map", "odom", Transform())
        now = await listener.wait_for("map", "odom")
        assert abs(now.stamp.to_sec() - Time.now().to_sec()) < 60


async def test_late_listeners_get_all_static_transforms(make_node: MakeNode) -> None:
    """Static transforms are there for later listeners all of them."""
    async with (
        make_node("robot") as robot,
        make_node("planner") as planner,
        StaticTransformBroadcaster(robot) as one,
        StaticTransformBroadcaster(robot) as other,
    ):
        one.send("base", "laser", Transform.make(x=1))
        one.send("base", "camera", Transform.make(x=2))
        one.send("base", "laser", Transform.make(x=3))
        other.send_stamped(StampedTransform("base", "arm", Transform.make(x=4)))
        async with TransformListener(planner) as listener:
            for frame, x in (("laser", 3), ("camera", 2), ("arm", 4)):
                assert x_of(await listener.wait_for("base", frame, timeout=20)) == x


async def test_robots_with_prefixes_share_a_map(core: Core, make_node: MakeNode) -> None:
    core.set_param("/robot1/tf_prefix", "robot1")
    core.set_param("/robot2/tf_prefix", "/robot2")
    async with (
        make_node("pose", namespace="robot1") as one,
        make_node("pose", namespace="robot2") as two,
        make_node("planner") as planner,
        TransformListener(one) as at_one,
        TransformListener(planner) as everything,
        TransformBroadcaster(one) as tf_one,
        TransformBroadcaster(two) as tf_two,
        asyncio.timeout(30),
    ):
        for tf, x in ((tf_one, 1), (tf_two, 2)):
            await tf._publisher.wait_for_subscribers(2)
            tf.send("/map", "base_link", Transform.make(x=x), at(10 + x))
        assert x_of(await at_one.wait_for("/map", "base_link")) == 1
        assert x_of(await everything.wait_for("map", "robot2/base_link")) == 2
        with pytest.raises(TransformTimeoutError, match="before the first"):
            await everything.wait_for("robot1/base_link", "robot2/base_link", timeout=0.01)
        tf_one.send("/map", "base_link", Transform.make(x=1.5), at(12))
        assert x_of(await everything.wait_for("robot1/base_link", "robot2/base_link")) == 0.5
        assert set(everything.buffer.frames) == {"map", "robot1/base_link", "robot2/base_link"}
        assert everything.prefix == ""
        async with TransformBroadcaster(one, prefix="other") as other:
            other.send("/map", "x", Transform())
            await everything.wait_for("map", "other/x")


async def test_waiting_ends_with_a_reason(make_node: MakeNode) -> None:
    async with (
        make_node("robot") as robot,
        TransformBroadcaster(robot) as tf,
        TransformListener(robot) as listener,
    ):
        with pytest.raises(TransformTimeoutError, match=r"waited 0\.01 s: there is no frame 'map'"):
            await listener.wait_for("map", "base", timeout=0.01)
        await tf._publisher.wait_for_subscribers(timeout=20)
        tf.send("map", "base", Transform(), at(10))
        await listener.wait_for("map", "base", timeout=20)
        with pytest.raises(TransformTimeoutError, match="after the last") as caught:
            await listener.wait_for("map", "base", at(11), timeout=0.01)
        assert isinstance(caught.value.reason, ExtrapolationError)
        with pytest.raises(ExtrapolationError, match="before the first"):
            await listener.wait_for("map", "base", at(9))
        waiting = asyncio.create_task(listener.wait_for("map", "base", at(11)))
        await asyncio.sleep(0)
        robot.shutdown("test")
        with pytest.raises(NodeClosedError):
            await asyncio.wait_for(waiting, 20)


async def test_bad_transforms_do_not_get_far(make_node: MakeNode, caplog: pytest.LogCaptureFixture) -> None:
    async with make_node("robot") as robot, TransformBroadcaster(robot) as tf:
        with pytest.raises(BadTransformError):
            tf.send("map", "map", Transform())
        with pytest.raises(BadTransformError):
            tf.send("", "base", Transform())
        async with TransformListener(robot) as listener:
            raw = await robot.advertise("/tf", "tf2_msgs/TFMessage")
            await raw.wait_for_subscribers(timeout=20)
            good = StampedTransform("map", "good", Transform()).fields
            with caplog.at_level(logging.WARNING):
                raw.publish(transforms=[{"child_frame_id": "bad"}, {"child_frame_id": "bad"}, good])
                await listener.wait_for("map", "good", timeout=20)
            assert caplog.text.count("transform from 'bad'") == 1
            assert set(listener.buffer.frames) == {"map", "good"}


async def test_restarted_simulation_has_an_empty_buffer(core: Core, make_node: MakeNode) -> None:
    """A simulation that begins anew begins with an empty buffer."""
    core.set_param("/use_sim_time", value=True)
    async with make_node("robot") as robot, TransformBroadcaster(robot) as tf:
        clock = await robot.advertise("/clock", "rosgraph_msgs/Clock")
        async with TransformListener(robot) as listener, asyncio.timeout(30):
            await clock.wait_for_subscribers()
            await tf._publisher.wait_for_subscribers()
            for start in (100, 50):
                clock.publish(clock=at(start))
                while robot.time() != start:
                    await robot.sleep(0)
                tf.send("map", "base", Transform.make(x=start))
                await listener.wait_for("map", "base", at(start))
            assert listener.buffer.latest_common_time("map", "base") == at(50)
            assert not listener.can_transform("map", "base", at(100))


ROSPY = """
import json, sys
import rospy, tf2_ros
from geometry_msgs.msg import TransformStamped

def edge(parent, child, x, stamp):
    message = TransformStamped()
    message.header.frame_id, message.child_frame_id, message.header.stamp = parent, child, stamp
    message.transform.translation.x, message.transform.rotation.w = x, 1
    return message

rospy.init_node("real")
buffer = tf2_ros.Buffer()
listener = tf2_ros.TransformListener(buffer)
static = tf2_ros.StaticTransformBroadcaster()
static.sendTransform([edge("base", "laser", 0.5, rospy.Time(0)), edge("base", "camera", 0.25, rospy.Time(0))])
moving = tf2_ros.TransformBroadcaster()
while not rospy.is_shutdown() and moving.pub_tf.get_num_connections() < 2:
    rospy.sleep(0.01)
for second in (10, 11):
    moving.sendTransform(edge("odom", "base", second, rospy.Time(second)))
found = buffer.lookup_transform("map", "laser", rospy.Time(10, 500000000), rospy.Duration(20))
print(json.dumps([found.transform.translation.x, found.header.stamp.to_sec()]), flush=True)
rospy.spin()
"""


@asynccontextmanager
async def rospy_node(core: Core, folder: Path) -> AsyncIterator[asyncio.subprocess.Process]:
    script = folder / "node.py"
    script.write_text(ROSPY)
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    process = await asyncio.create_subprocess_exec(
        "/usr/bin/python3",
        str(script),
        env=kept
        | {
            "ROS_MASTER_URI": core.uri,
            "ROS_IP": "127.0.0.1",
            "PATH": "/usr/bin:/bin",
            "HOME": str(folder),
        },
        stdout=asyncio.subprocess.PIPE,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


@pytest.mark.needs("tf2")
async def test_with_tf2_of_ros_both_ways(core: Core, make_node: MakeNode, tmp_path: Path) -> None:
    async with (
        make_node("ours") as ours,
        StaticTransformBroadcaster(ours) as static,
        TransformListener(ours) as listener,
        rospy_node(core, tmp_path) as process,
        asyncio.timeout(50),
    ):
        static.send("earth", "map", Transform.make(x=1000))
        static.send("map", "odom", Transform.make(x=100))
        answer = await listener.wait_for("map", "laser", at(10.5))
        assert x_of(answer) == pytest.approx(111.0)
        assert x_of(await listener.wait_for("earth", "camera", at(11))) == pytest.approx(1111.25)
        assert process.stdout is not None
        assert json.loads(await process.stdout.readline()) == [pytest.approx(111.0), 10.5]
