"""The examples in ``examples/ros``, each with a real ROS at its other end."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from support.ros_real import Graph, interrupt

from rce.ros.types import TypeRegistry

pytestmark = [pytest.mark.needs("rospy", "rostopic")]

EXAMPLES = Path(__file__).parents[3] / "examples" / "ros"
STRING = "std_msgs/String"


class Example:
    """A running program and what it prints."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process

    async def line(self) -> str:
        assert self.process.stdout is not None
        async with asyncio.timeout(45):
            return (await self.process.stdout.readline()).decode().strip()

    async def rest(self) -> list[str]:
        output, _ = await asyncio.wait_for(self.process.communicate(), 45)
        assert self.process.returncode == 0
        return output.decode().splitlines()


@contextlib.asynccontextmanager
async def running(graph: Graph, *argv: str) -> AsyncIterator[Example]:
    process = await asyncio.create_subprocess_exec(
        *argv, env=graph.env, cwd=graph.home, stdout=asyncio.subprocess.PIPE, start_new_session=True
    )
    try:
        yield Example(process)
    finally:
        await interrupt(process)


def example(graph: Graph, name: str, *arguments: str) -> contextlib.AbstractAsyncContextManager[Example]:
    return running(graph, sys.executable, str(EXAMPLES / name), *arguments)


def rospy(graph: Graph, text: str) -> contextlib.AbstractAsyncContextManager[Example]:
    script = graph.home / "program.py"
    script.write_text(text)
    return running(graph, "/usr/bin/python3", str(script))


async def test_talker_and_listener(ours: Graph) -> None:
    async with example(ours, "talker.py"):
        await ours.until(lambda: ours.publishers("/chatter"), what="the talker is there")
        assert 'data: "hello ' in await ours.tool("rostopic", "echo", "-n1", "/chatter")
    async with example(ours, "listener.py") as listener:
        await ours.until(lambda: ours.node("/listener"), what="the listener is there")
        await ours.tool("rostopic", "pub", "-1", "/chatter", STRING, "data: from a real tool")
        assert await listener.line() == "from a real tool"


SWITCH = """
import rospy
from std_srvs.srv import SetBool, SetBoolResponse
rospy.init_node("switch")
rospy.Service("switch", SetBool, lambda request: SetBoolResponse(True, "rospy says %s" % request.data))
rospy.spin()
"""


async def test_service(ours: Graph) -> None:
    async with example(ours, "service_server.py"):
        await ours.until(lambda: ours.service("/switch"), what="the service is there")
        for message in ("False -> True", "True -> True"):
            assert message in await ours.tool("rosservice", "call", "/switch", "true")
    async with rospy(ours, SWITCH), example(ours, "service_client.py") as client:
        assert await client.rest() == ["rospy says True", "rospy says False"]


async def test_parameters(ours: Graph) -> None:
    await ours.tool("rosparam", "set", "/control/axes", "[a, b]")
    async with example(ours, "parameters.py", "_gain:=2.5") as program:
        assert (await program.rest())[0] == "control: {'gain': 2.5, 'axes': ['x', 'y']}"
    assert (await ours.tool("rosparam", "get", "/control")).strip() == "gain: 2.5"


FIBONACCI_SERVER = """
import actionlib, rospy
from actionlib_tutorials.msg import FibonacciAction, FibonacciFeedback, FibonacciResult

def execute(goal):
    sequence = [0, 1]
    while len(sequence) <= goal.order:
        if server.is_preempt_requested():
            return server.set_preempted()
        sequence.append(sequence[-1] + sequence[-2])
        server.publish_feedback(FibonacciFeedback(sequence))
        rospy.sleep(0.05)
    server.set_succeeded(FibonacciResult(sequence))

rospy.init_node("fibonacci")
server = actionlib.SimpleActionServer("fibonacci", FibonacciAction, execute, auto_start=False)
server.start()
rospy.spin()
"""

FIBONACCI_CLIENT = """
import actionlib, rospy
from actionlib_tutorials.msg import FibonacciAction, FibonacciGoal

rospy.init_node("client")
client = actionlib.SimpleActionClient("fibonacci", FibonacciAction)
assert client.wait_for_server(rospy.Duration(20))
client.send_goal(FibonacciGoal(4))
assert client.wait_for_result(rospy.Duration(20))
print(*client.get_result().sequence, flush=True)
"""


def make_classes(home: Path) -> None:
    """Have genpy make the classes of a package that Debian does not have."""
    types, package = TypeRegistry(), home / "actionlib_tutorials"
    (package / "msg").mkdir(parents=True)
    sources = []
    for part in ("Action", "ActionGoal", "ActionResult", "ActionFeedback", "Goal", "Result", "Feedback"):
        kind = types.message(f"actionlib_tutorials/Fibonacci{part}")
        source = package / f"Fibonacci{part}.msg"
        source.write_text(kind.definition.partition("=" * 80)[0])
        sources.append(str(source))
    found = [
        part for name in ("actionlib_msgs", "std_msgs") for part in ("-I", f"{name}:/usr/share/{name}/msg")
    ]
    common = ("-p", "actionlib_tutorials", "-o", str(package / "msg"))
    own = ("-I", f"actionlib_tutorials:{package}")
    generator = ("/usr/bin/python3", "/usr/lib/genpy/genmsg_py.py")
    subprocess.run([*generator, *common, *own, *found, *sources], check=True)
    subprocess.run([*generator, "--initpy", *common], check=True)
    (package / "__init__.py").touch()


@pytest.mark.needs("actionlib")
async def test_action(ours: Graph) -> None:
    make_classes(ours.home)
    async with (
        example(ours, "fibonacci_server.py", "_period:=0.05"),
        rospy(ours, FIBONACCI_CLIENT) as asking,
    ):
        assert await asking.rest() == ["0 1 1 2 3"]
    async with rospy(ours, FIBONACCI_SERVER), example(ours, "fibonacci_client.py", "_order:=4") as client:
        lines = await client.rest()
        assert lines[-2:] == ["result: 0 1 1 2 3", "ended: preempted"]


TF_LISTENER = """
import rospy, tf2_ros
rospy.init_node("where")
buffer = tf2_ros.Buffer()
listener = tf2_ros.TransformListener(buffer)
found = buffer.lookup_transform("map", "laser", rospy.Time(0), rospy.Duration(20))
print("%.2f" % (found.transform.translation.x ** 2 + found.transform.translation.y ** 2), flush=True)
"""

TF_BROADCASTER = """
import rospy, tf2_ros
from geometry_msgs.msg import TransformStamped
rospy.init_node("fixed")
broadcaster = tf2_ros.StaticTransformBroadcaster()
edge = TransformStamped()
edge.header.stamp, edge.header.frame_id, edge.child_frame_id = rospy.Time.now(), "map", "laser"
edge.transform.translation.x, edge.transform.rotation.w = 1.5, 1.0
broadcaster.sendTransform(edge)
rospy.spin()
"""


@pytest.mark.needs("tf2")
async def test_transforms(ours: Graph) -> None:
    async with example(ours, "tf_broadcaster.py"), rospy(ours, TF_LISTENER) as asking:
        assert await asking.rest() == ["4.09"]  # a circle of 2 m, and 0.3 m on its tangent
    async with rospy(ours, TF_BROADCASTER), example(ours, "tf_listener.py") as where:
        assert await where.line() == "laser at x=1.50 m, y=0.00 m, yaw=0.00 rad"
