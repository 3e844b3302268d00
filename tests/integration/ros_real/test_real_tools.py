"""The command line tools of a real ROS with our nodes, at our core and at a real one."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
from support.ros_nodes import MakeGraphNode
from support.ros_real import Graph

from rce.ros.errors import ServiceFaultError
from rce.ros.types import Message

pytestmark = [pytest.mark.needs("rospy", "rostopic")]

STRING = "std_msgs/String"
RCE = str(Path(sys.executable).parent / "rce")


async def test_rostopic(graph: Graph, make_node: MakeGraphNode) -> None:
    async with make_node(graph, "ours", namespace="robot") as ours:
        said: asyncio.Queue[str] = asyncio.Queue()
        await ours.subscribe("heard", STRING, lambda message: said.put_nowait(message.data))
        publisher = await ours.advertise("said", STRING, latch=True)
        publisher.publish(data="hello tools")
        listed = set((await graph.tool("rostopic", "list")).split())
        assert listed == {"/robot/heard", "/robot/said", "/rosout", "/rosout_agg"}
        info = await graph.tool("rostopic", "info", "/robot/said")
        assert "Type: std_msgs/String" in info
        assert f"/robot/ours ({ours.uri})" in info
        assert (await graph.tool("rostopic", "type", "/robot/said")).strip() == STRING
        assert set((await graph.tool("rostopic", "find", STRING)).split()) == {"/robot/heard", "/robot/said"}
        assert 'data: "hello tools"' in await graph.tool("rostopic", "echo", "-n1", "/robot/said")
        assert set((await graph.tool("rostopic", "list", "-p")).split()) >= {"/robot/said", "/rosout_agg"}
        await graph.tool("rostopic", "pub", "-1", "/robot/heard", STRING, "data: hi")
        assert await asyncio.wait_for(said.get(), 30) == "hi"


async def test_rostopic_measures(graph: Graph, make_node: MakeGraphNode) -> None:
    async with make_node(graph, "ours") as node:
        publisher = await node.advertise("t", STRING)
        node.timer(0.02, lambda _: publisher.publish(data="x" * 996))
        rate = await graph.says("rostopic", "hz", "-w", "30", "/t", text="average rate", count=3)
        assert float(rate.rpartition("average rate: ")[2].split()[0]) > 0
        bandwidth = await graph.says("rostopic", "bw", "/t", text="average:", count=2)
        assert "mean: 1.00KB" in bandwidth


async def test_rosnode(graph: Graph, make_node: MakeGraphNode) -> None:
    async with (
        make_node(graph, "ours") as ours,
        make_node(graph, "victim", intra_process=False) as victim,
    ):
        await ours.advertise("t", STRING)
        heard = await victim.subscribe("t", STRING)
        await heard.wait_for_publishers(timeout=20)
        assert {"/ours", "/victim", "/rosout"} <= set((await graph.tool("rosnode", "list")).split())
        info = await graph.tool("rosnode", "info", "/ours")
        assert "* /t [std_msgs/String]" in info
        assert f"Pid: {os.getpid()}" in info
        assert "* /ours/get_loggers" in info
        assert "* to: /victim\n    * direction: outbound" in info
        assert "transport: TCPROS" in info
        assert "xmlrpc reply from" in await graph.tool("rosnode", "ping", "-c", "2", "/ours")
        assert "/ours" in await graph.tool("rosnode", "machine", "127.0.0.1")
        assert "killed" in await graph.tool("rosnode", "kill", "/victim")
        await asyncio.wait_for(victim.spin(), 20)
    assert "/victim" not in await graph.tool("rosnode", "list")


async def test_rosservice(graph: Graph, make_node: MakeGraphNode) -> None:
    async with make_node(graph, "ours") as ours:

        async def loggers(request: Message) -> dict[str, Any]:
            return {"loggers": [{"name": "a", "level": "info"}, {"name": "b", "level": "debug"}]}

        def refuse(request: Message) -> None:
            raise ServiceFaultError("/refuse", "never")

        await ours.advertise_service("get", "roscpp/GetLoggers", loggers)
        await ours.advertise_service("set", "std_srvs/SetBool", lambda request: {"success": request.data})
        await ours.advertise_service("refuse", "roscpp/Empty", refuse)
        listed = set((await graph.tool("rosservice", "list")).split())
        assert {"/get", "/set", "/refuse", "/ours/get_loggers", "/ours/set_logger_level"} <= listed
        info = await graph.tool("rosservice", "info", "/set")
        assert "Node: /ours" in info
        assert "Type: std_srvs/SetBool" in info
        assert "Args: data" in info
        assert (await graph.tool("rosservice", "type", "/get")).strip() == "roscpp/GetLoggers"
        assert (await graph.tool("rosservice", "args", "/set")).strip() == "data"
        assert (await graph.tool("rosservice", "uri", "/set")).strip() == await graph.service("/set")
        assert (await graph.tool("rosservice", "find", "std_srvs/SetBool")).strip() == "/set"
        assert "success: True" in await graph.tool("rosservice", "call", "/set", "true")
        assert 'name: "b"' in await graph.tool("rosservice", "call", "/get")
        assert "never" in await graph.tool("rosservice", "call", "/refuse", check=False)
        level = "{logger: rosout, level: debug}"
        await graph.tool("rosservice", "call", "/ours/set_logger_level", level)
        assert ours.log.isEnabledFor(10)
        ours.log.setLevel("INFO")


async def test_rosparam(graph: Graph, make_node: MakeGraphNode) -> None:
    async with make_node(graph, "ours") as ours:
        told: asyncio.Queue[tuple[str, object]] = asyncio.Queue()
        await ours.watch_param("/tree", lambda *change: told.put_nowait(change))
        assert await ours.get_param_cached("/tree/a", "not yet") == "not yet"
        await graph.tool("rosparam", "set", "/tree", "{a: 1, b: [1, 2.5, x], c: {d: true}}")
        tree = {"a": 1, "b": [1, 2.5, "x"], "c": {"d": True}}

        async def known() -> bool:
            found = await ours.get_param_cached("/tree", None), await ours.get_param_cached("/tree/a", None)
            return bool(found == (tree, 1))

        await graph.until(known, what="the cache has the values")
        assert await ours.get_param("/tree") == tree
        assert {told.get_nowait()[0].rstrip("/") for _ in range(told.qsize())} >= {"/tree/a", "/tree/b"}
        await ours.set_param("/tree/a", "text")
        assert await ours.get_param_cached("/tree/a") == "text"
        assert (await graph.tool("rosparam", "get", "/tree/a")).strip() == "text"
        file = graph.home / "dump.yaml"
        await graph.tool("rosparam", "dump", str(file), "/tree")
        await graph.tool("rosparam", "delete", "/tree")
        assert not await ours.has_param("/tree")
        await graph.tool("rosparam", "load", str(file), "/back")
        assert await ours.get_param("/back/c/d") is True
        listed = set((await graph.tool("rosparam", "list")).split())
        assert {"/back/a", "/rosdistro", "/rosversion", "/run_id"} <= listed
        assert any(name.startswith("/roslaunch/uris/host_") for name in listed)


@pytest.mark.needs("rosmsg")
async def test_rosmsg_agrees_on_types(ours: Graph, make_node: MakeGraphNode) -> None:
    async with make_node(ours, "ours") as node:
        publisher = await node.advertise("pose", "geometry_msgs/PoseStamped")
        md5 = await ours.tool("rosmsg", "md5", "geometry_msgs/PoseStamped")
        assert publisher.type.md5sum in md5
        shown = await ours.tool("rosmsg", "show", "geometry_msgs/PoseStamped")
        assert [line.split()[-1] for line in shown.splitlines() if line and not line.startswith(" ")] == [
            field.name for field in publisher.type.fields
        ]


@pytest.mark.needs("topic_tools")
async def test_topic_tools(graph: Graph, make_node: MakeGraphNode) -> None:
    async with make_node(graph, "ours") as node:
        got: dict[str, asyncio.Queue[str]] = {}

        async def listen(topic: str) -> asyncio.Queue[str]:
            queue = got[topic] = asyncio.Queue()
            await node.subscribe(topic, STRING, lambda message: queue.put_nowait(message.data))
            return queue

        first, second = await node.advertise("first", STRING), await node.advertise("second", STRING)
        tools = "/usr/lib/topic_tools"
        async with (
            graph.program(f"{tools}/relay", "/first", "/relayed", "__name:=relay"),
            graph.program(f"{tools}/throttle", "messages", "/first", "1.0", "/slow", "__name:=slower"),
            graph.program(f"{tools}/drop", "/first", "1", "2", "/half", "__name:=dropper"),
            graph.program(f"{tools}/mux", "/chosen", "/first", "/second", "__name:=mux"),
        ):
            relayed, slow = await listen("relayed"), await listen("slow")
            half, chosen = await listen("half"), await listen("chosen")
            await first.wait_for_subscribers(4, timeout=40)
            # They advertise when they have seen a message, and so may lose the first ones.
            numbers = iter(range(10_000))
            for queue in (relayed, slow, half, chosen):
                async with asyncio.timeout(40):
                    while queue.empty():
                        first.publish(data=f"first {next(numbers)}")
                        await asyncio.sleep(0.05)
            assert relayed.qsize() > slow.qsize()
            await graph.tool("rosservice", "call", "/mux/select", "/second")
            async with asyncio.timeout(40):
                while not (await chosen.get()).startswith("second"):
                    second.publish(data="second")


@pytest.mark.needs("rosbag")
async def test_rosbag(graph: Graph, make_node: MakeGraphNode) -> None:
    bag = graph.home / "test.bag"
    async with make_node(graph, "ours") as node:
        pose = await node.advertise("pose", "geometry_msgs/PoseStamped", latch=True)
        text = await node.advertise("text", STRING)
        async with graph.program("rosbag", "record", "-O", str(bag), "/pose", "/text") as recording:
            await pose.wait_for_subscribers(timeout=40)
            await text.wait_for_subscribers(timeout=40)
            pose.publish(header={"frame_id": "map"})
            for number in range(20):
                text.publish(data=str(number))
            async with asyncio.timeout(40):
                while not (graph.home / "test.bag.active").exists():
                    await asyncio.sleep(0.05)
                await asyncio.sleep(1)  # the recorder tells nobody when it has taken a message
            recording.send_signal(2)
            await recording.wait()
            async with asyncio.timeout(40):
                while not bag.exists():  # the command may end before the recorder that it started
                    await asyncio.sleep(0.05)
        info = await graph.tool("rosbag", "info", str(bag))
        assert f"geometry_msgs/PoseStamped [{pose.type.md5sum}]" in info
        assert f"std_msgs/String           [{text.type.md5sum}]" in info
        assert "20 msgs" in info
        script = (
            "import rosbag, sys\n"
            "bag = rosbag.Bag(sys.argv[1])\n"
            "for c in bag._get_connections():\n"
            "    if c.topic == '/pose': print(c.msg_def)\n"
        )
        definition = await graph.tool("/usr/bin/python3", "-c", script, str(bag))
        assert definition.strip() == pose.type.definition.strip()
    async with make_node(graph, "listener") as listener:
        heard = await listener.subscribe("text", STRING)
        frames = await listener.subscribe("pose", "geometry_msgs/PoseStamped")
        await graph.tool("rosbag", "play", "--wait-for-subscribers", str(bag))
        async with asyncio.timeout(60):
            assert [(await anext(aiter(heard))).data for _ in range(20)] == [str(n) for n in range(20)]
            assert (await anext(aiter(frames))).header.frame_id == "map"


@pytest.mark.needs("rosbag")
async def test_rosbag_plays_the_clock(graph: Graph, make_node: MakeGraphNode) -> None:
    async with make_node(graph, "setter") as setter:
        await setter.set_param("/use_sim_time", True)
    bag = graph.home / "clock.bag"
    script = (
        "import genpy, rosbag, sys, std_msgs.msg\n"
        "bag = rosbag.Bag(sys.argv[1], 'w')\n"
        "for n in range(10): bag.write('/t', std_msgs.msg.String(str(n)), genpy.Time(1000 + n))\n"
        "bag.close()\n"
    )
    await graph.tool("/usr/bin/python3", "-c", script, str(bag))
    async with make_node(graph, "listener") as listener:
        assert listener.is_time_simulated
        heard = await listener.subscribe("t", STRING)
        asleep = asyncio.create_task(listener.sleep(5.0))  # from the first message of /clock on
        await graph.tool("rosbag", "play", "--clock", "-r", "10", "--wait-for-subscribers", str(bag))
        assert await asyncio.wait_for(asleep, 20)
        assert 1005 < listener.time() < 1010
        assert (await asyncio.wait_for(anext(aiter(heard)), 20)).data == "0"


LAUNCH = """<launch>
  <param name="/from_launch" value="yes"/>
  <rosparam param="/tree">{a: 1, b: [x, y]}</rosparam>
  <group ns="robot">
    <remap from="peer_in" to="/in"/>
    <node pkg="topic_tools" type="relay" name="relay" args="/launched_in /launched_out"/>
  </group>
</launch>
"""


@pytest.mark.needs("roslaunch", "topic_tools")
async def test_roslaunch(graph: Graph, make_node: MakeGraphNode) -> None:
    (graph.home / "a.launch").write_text(LAUNCH)
    async with make_node(graph, "ours") as node:
        out = await node.subscribe("launched_out", STRING)
        publisher = await node.advertise("launched_in", STRING)
        async with graph.program("roslaunch", "--wait", str(graph.home / "a.launch"), node="/robot/relay"):
            await publisher.wait_for_subscribers(timeout=40)
            heard = asyncio.create_task(out.__anext__())
            async with asyncio.timeout(40):
                while not heard.done():
                    publisher.publish(data="through it")
                    await asyncio.sleep(0.05)
            assert heard.result().data == "through it"
            assert await node.get_param("/from_launch") == "yes"
            assert await node.get_param("/tree") == {"a": 1, "b": ["x", "y"]}
        await graph.until(lambda: is_gone(graph, "/robot/relay"), what="the launched node is gone")


async def is_gone(graph: Graph, name: str) -> bool:
    return await graph.node(name) is None


OUR_NODE = """#!{python}
import asyncio
from rce.ros.node import Node, run

async def main():
    async with Node("unnamed") as node:
        said = await node.advertise("said", "std_msgs/String", latch=True)
        said.publish(data=f"{{node.name}} {{await node.get_param('~word')}}")
        node.log.warning("was launched")
        await node.spin()

run(main())
"""

OUR_LAUNCH = """<launch>
  <node pkg="launched" type="ours.py" name="first" ns="robot" respawn="true">
    <param name="word" value="hello"/>
    <remap from="said" to="/told"/>
  </node>
</launch>
"""


@pytest.mark.needs("roslaunch")
async def test_roslaunch_starts_our_node(graph: Graph, make_node: MakeGraphNode) -> None:
    package = graph.home / "launched"
    package.mkdir()
    (package / "package.xml").write_text("<package><name>launched</name></package>")
    (package / "ours.py").write_text(OUR_NODE.format(python=sys.executable))
    (package / "ours.py").chmod(0o755)
    (package / "ours.launch").write_text(OUR_LAUNCH)
    async with make_node(graph, "listener") as node:
        told = await node.subscribe("/told", STRING)
        launch = str(package / "ours.launch")
        async with graph.program("roslaunch", "--wait", launch, node="/robot/first") as roslaunch:
            async with asyncio.timeout(40):
                assert (await anext(aiter(told))).data == "/robot/first hello"
            listed = await graph.tool("rosnode", "info", "/robot/first")
            (pid,) = re.findall(r"Pid: (\d+)", listed)
            os.kill(int(pid), signal.SIGKILL)
            async with asyncio.timeout(40):  # it is started again, and says so
                assert (await anext(aiter(told))).data == "/robot/first hello"
            roslaunch.send_signal(signal.SIGINT)
            await asyncio.wait_for(roslaunch.wait(), 30)
        assert await is_gone(graph, "/robot/first")
    (log,) = graph.home.glob(".ros/log/*-*/robot-first-1.log")
    assert log.read_text().count("[WARNING]") == 2


async def test_rce_relay(graph: Graph, make_node: MakeGraphNode) -> None:
    relay = (RCE, "relay", "/from", "/to", "--name", "relay")
    slow = (RCE, "relay", "/from", "/slow", "--name", "slow", "--throttle", "0.01")
    async with (
        make_node(graph, "ours") as node,
        graph.program(*relay, node="/relay"),
        graph.program(*slow, node="/slow"),
    ):
        heard: list[str] = []
        held: list[str] = []
        await node.subscribe("/to", STRING, lambda message: heard.append(message.data))
        await node.subscribe("/slow", STRING, lambda message: held.append(message.data))
        await graph.tool("rostopic", "pub", "-1", "/from", STRING, "data: first")
        await graph.until(lambda: _true(heard == held == ["first"]), what="a real publisher is relayed")
        assert (await graph.tool("rostopic", "type", "/to")).strip() == STRING
        publisher = await node.advertise("/from", STRING)
        await publisher.wait_for_subscribers(2, timeout=20)
        for number in range(5):
            publisher.publish(data=str(number))
        await graph.until(lambda: _true(len(heard) == 6), what="all are relayed")
        assert heard[1:] == [str(number) for number in range(5)]
        assert "* topic: /from" in await graph.tool("rosnode", "info", "/slow")  # it had the time for more
        assert held == ["first"]


async def _true(value: bool) -> bool:
    return value


ROSTEST = """<launch>
  <test test-name="hear" pkg="rostest" type="hztest" name="hear" time-limit="60">
    <param name="topic" value="/beat"/>
    <param name="hz" value="20.0"/>
    <param name="hzerror" value="15.0"/>
    <param name="test_duration" value="2.0"/>
  </test>
</launch>
"""


@pytest.mark.needs("roslaunch")
async def test_rostest(ours: Graph, make_node: MakeGraphNode) -> None:
    (ours.home / "package.xml").write_text("<package><name>tests_of_ours</name></package>")
    (ours.home / "hz.test").write_text(ROSTEST)
    async with make_node(ours, "ours") as node:
        publisher = await node.advertise("beat", STRING)
        node.timer(0.05, lambda _: publisher.publish(data="beat"))
        printed = await ours.tool("rostest", "--reuse-master", "--text", str(ours.home / "hz.test"))
        assert "RESULT: SUCCESS" in printed


@pytest.mark.needs("roslaunch")
async def test_roswtf_finds_no_fault_in_the_graph(ours: Graph, make_node: MakeGraphNode) -> None:
    async with (
        make_node(ours, "talker") as talker,
        make_node(ours, "listener", intra_process=False) as listener,
    ):
        publisher = await talker.advertise("t", STRING)
        await listener.subscribe("t", STRING)
        await publisher.wait_for_subscribers(timeout=20)
        printed = await ours.tool("roswtf", check=False)
        assert "Online checks summary" in printed, printed
        online = printed.partition("Online checks summary")[2]
        assert "ERROR" not in online, printed
