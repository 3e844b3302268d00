"""Nodes that crash, hang, wait for each other and talk: their life and their logs, with real processes."""

from __future__ import annotations

import asyncio
import os
import signal
from typing import TypedDict, Unpack

import pytest
from support.container_peers import joined
from support.containers import Machine, until
from support.parts import NodeLife

from rce.control.logs import LogLevel, LogQuery, LogStream
from rce.control.messages import LogChunk, ReadLog, Status
from rce.control.model import EndpointState, NodeState
from rce.model.specs import InterfaceSpec, NodeSpec, RestartPolicy
from rce.ros.types import TypeRegistry

BOX = "user/box"
STRING = TypeRegistry().message("std_msgs/String")

NODES = {
    "crash.py": (
        "import sys\nprint('to stdout', flush=True)\nprint('it is broken', file=sys.stderr)\nsys.exit(3)\n"
    ),
    # Its first life beats for a second, then hangs and does not end on SIGINT; later ones beat indefinitely.
    "beat.py": (
        "import asyncio, pathlib, signal, sys, time\n"
        "from rce.ros.node import Node, run\n"
        "async def main():\n"
        "    async with Node('beater') as node:\n"
        "        beat = await node.advertise('beat', 'std_msgs/Empty')\n"
        "        done = pathlib.Path('hung')\n"
        "        while done.exists() or time.monotonic() < START + 1.0:\n"
        "            beat.publish()\n"
        "            await asyncio.sleep(0.05)\n"
        "        done.touch()\n"
        "        signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "        time.sleep(600)\n"
        "START = time.monotonic()\n"
        "run(main())\n"
    ),
    # Takes its time before it registers; prints what it hears.
    "hear.py": (
        "import asyncio, sys, time\n"
        "from rce.ros.node import Node, run\n"
        "async def main():\n"
        "    async with Node(sys.argv[1]) as node:\n"
        "        def hear(message):\n"
        "            print('heard', message.data, flush=True)\n"
        "        await node.subscribe(sys.argv[2], 'std_msgs/String', hear)\n"
        "        print('ready', flush=True)\n"
        "        await node.spin()\n"
        "    print('left at', time.monotonic(), flush=True)\n"
        "time.sleep(float(sys.argv[3]))\n"
        "run(main())\n"
    ),
    "tell.py": (
        "import sys\n"
        "from rce.ros.node import Node, run\n"
        "async def main():\n"
        "    async with Node('teller') as node:\n"
        "        print('printed', flush=True)\n"
        "        print('complained', file=sys.stderr, flush=True)\n"
        "        node.log.info('just saying')\n"
        "        node.log.error('this is bad')\n"
        "        await node.spin()\n"
        "run(main())\n"
    ),
}


@pytest.fixture(autouse=True)
def _nodes(machine: Machine) -> None:
    for name, text in NODES.items():
        (machine.packages / "own" / "nodes" / name).write_text(text)


class QueryParts(TypedDict, total=False):
    level: LogLevel
    incarnation: str
    previous: bool


def own(exe: str, args: str = "", tag: str = "node", **life: Unpack[NodeLife]) -> NodeSpec:
    return NodeSpec(tag=tag, pkg="own", exe=exe, args=args, **life)


async def read(
    machine: Machine, node: str, *streams: LogStream, id_: str = BOX, **query: Unpack[QueryParts]
) -> LogChunk:
    request = ReadLog(request=1, id=id_, node=node, limit=1 << 20, query=LogQuery(streams=streams, **query))
    return await machine.read_log(request)


async def holds(
    machine: Machine, node: str, text: str, *streams: LogStream, **query: Unpack[QueryParts]
) -> str:
    async with asyncio.timeout(60):
        while text not in (found := (await read(machine, node, *streams, **query)).text):
            await asyncio.sleep(0.02)
    return found


def states(machine: Machine, tag: str = "node") -> list[NodeState]:
    """All states of a node that the master was told of, in order."""
    found: list[NodeState] = []
    for message in machine.of(Status):
        for node in message.status.nodes:
            if node.tag == tag and found[-1:] != [node.state]:
                found.append(node.state)
    return found


async def test_a_node_that_crashes_is_restarted_up_to_its_limit(machine: Machine) -> None:
    crash = own("crash.py", restart=RestartPolicy.ON_FAILURE, max_restarts=2)
    async with machine.engine():
        await machine.put(BOX, nodes=(crash, own("talk.py", tag="other")))
        node = await machine.node_is(BOX, "node", NodeState.FAILED)
        assert (node.restarts, node.exit_code, node.pid) == (2, 3, 0)
        assert node.detail.startswith(
            "exit code 3; its last output: it is broken; it was started again 2 times"
        )
        assert [one for one in states(machine) if one is NodeState.WAITING] == [NodeState.WAITING] * 2
        assert machine.reported(BOX).state is EndpointState.DEGRADED
        text = (await read(machine, "node")).text
        assert text.count("it is broken\n") == text.count("to stdout\n") == 3
        ended = "-- ended: exit code 3; its last output: it is broken --\n"
        pauses = "".join(f"{ended}-- starts again after {pause} s --\n" for pause in ("0.5", "1"))
        assert (await read(machine, "node", LogStream.ENGINE)).text == pauses + ended
        assert len([text for text in machine.faults if "node node" in text]) == 2
        await machine.put(BOX, 2, nodes=(own("talk.py"), own("talk.py", tag="other")))
        await until(lambda: machine.reported(BOX).state is EndpointState.RUNNING, what="all is well again")
        assert machine.reported_node(BOX, "node").restarts == 0


async def test_nodes_start_in_order_and_say_what_they_await(machine: Machine) -> None:
    """Nodes start one after the other and say what they wait for."""
    async with machine.engine():
        await machine.put(
            BOX,
            nodes=(
                own("hear.py", "last x 0", tag="last", after=("slow", "once")),
                own("hear.py", "slow x 0.5", tag="slow"),
                own("end.py", tag="once"),
                own("talk.py", tag="a", after=("b",)),
                own("talk.py", tag="b", after=("a",)),
                own("talk.py", tag="c", after=("nobody",)),
            ),
        )
        assert (await machine.node_is(BOX, "last", NodeState.WAITING)).detail.startswith("waits for slow")
        assert machine.reported_node(BOX, "a").detail.startswith("waits for itself (a after b after a)")
        assert machine.reported_node(BOX, "c").detail.startswith("waits for 'nobody'")
        await machine.node_is(BOX, "last", NodeState.RUNNING)
        assert machine.reported_node(BOX, "slow").state is NodeState.RUNNING
        assert machine.reported_node(BOX, "once").state is NodeState.EXITED
        for tag in "abc":
            assert machine.reported_node(BOX, tag).state is NodeState.WAITING
            assert any(f"node {tag} waits for" in fault for fault in machine.faults)


async def test_nodes_end_in_the_reverse_of_their_order(machine: Machine) -> None:
    async with machine.engine():
        await machine.put(
            BOX,
            nodes=(
                own("hear.py", "first x 0", tag="first"),
                own("hear.py", "second x 0", tag="second", after=("first",)),
                own("hear.py", "third x 0", tag="third", after=("second",)),
            ),
        )
        for tag in ("first", "second", "third"):
            await holds(machine, tag, "ready", LogStream.STDOUT)
        await machine.drop(BOX)
        left = {}
        for tag in ("first", "second", "third"):
            text = (await read(machine, tag, LogStream.STDOUT)).text
            left[tag] = float(text.rpartition("left at")[2])
            assert "ended: it was told to" in (await read(machine, tag, LogStream.ENGINE)).text
        assert left["third"] < left["second"] < left["first"]


async def test_a_node_whose_heart_stops_is_restarted(machine: Machine) -> None:
    beat = own("beat.py", heartbeat="beat", heartbeat_timeout=2.0, restart=RestartPolicy.ALWAYS)
    async with machine.engine(interrupt_timeout=0.3, terminate_timeout=0.3):
        await machine.put(BOX, nodes=(beat,))
        await until(lambda: NodeState.STUCK in states(machine), what="the node is stuck")
        first = await machine.node_is(BOX, "node", NodeState.RUNNING)
        assert first.restarts == 1
        await until(lambda: machine.reported(BOX).state is EndpointState.RUNNING, what="all is well again")
        found = states(machine)
        stuck = found.index(NodeState.STUCK)
        assert found[stuck : stuck + 5] == [
            NodeState.STUCK,
            NodeState.STOPPING,
            NodeState.WAITING,
            NodeState.STARTING,
            NodeState.RUNNING,
        ]
        assert EndpointState.DEGRADED in [message.status.state for message in machine.of(Status)]
        assert any(
            "is stuck: no message on beat any more; it is restarted" in text for text in machine.faults
        )
        text = (await read(machine, "node", LogStream.ENGINE)).text
        assert text.splitlines() == [
            "-- stuck: no message on beat any more --",
            "-- ended: killed, because it did not end on SIGINT and SIGTERM --",
            "-- starts again after 0.5 s --",
        ]


async def test_established_connection_reaches_late_nodes(machine: Machine) -> None:
    """What is sent when st is true is heard by nodes that start late."""
    interface = InterfaceSpec(
        tag="req", type="PublisherInterface", message_type="std_msgs/String", addr="late"
    )
    async with machine.engine():
        await machine.put(
            BOX,
            nodes=(
                own("hear.py", "early other 0.5", tag="early"),
                own("hear.py", "late late 0.5", tag="late", after=("early",)),
            ),
            interfaces=(interface,),
            peer="user/robot",
        )
        address = (await until(lambda: machine.status(BOX), what="a status")).address
        async with joined(address) as peer:
            await peer.active("req")
            peer.ends["req"].port.send(STRING.serialize(STRING.new(data="the first")))
            await holds(machine, "late", "heard the first")
            assert machine.faults == []


async def test_streams_and_log_records_are_told_apart(machine: Machine) -> None:
    async with machine.engine():
        await machine.put(BOX, nodes=(own("tell.py"),))
        await holds(machine, "node", "this is bad", LogStream.ROSOUT)
        assert (await read(machine, "node", LogStream.STDOUT)).text == "printed\n"
        assert "complained\n" in (await read(machine, "node", LogStream.STDERR)).text
        records = (await read(machine, "node", LogStream.ROSOUT)).text.splitlines()
        assert [line.partition(" ")[0] for line in records if "ing" in line or "bad" in line] == [
            "[INFO]",
            "[ERROR]",
        ]
        serious = (await read(machine, "node", LogStream.ROSOUT, level=LogLevel.ERROR)).text
        assert (serious.count("\n"), "this is bad" in serious) == (1, True)
        text = await holds(machine, "", "this is bad", LogStream.ROSOUT)
        assert " ERROR /teller [" in text
        assert text.splitlines()[2].endswith("  Node Startup")


@pytest.mark.needs("rospy")
async def test_records_of_a_rospy_node_go_to_its_log(machine: Machine) -> None:
    package = machine.packages / "sys"
    (package / "nodes").mkdir(parents=True)
    (package / "package.yaml").write_text("name: sys\npython: system\n")
    script = package / "nodes" / "tell.py"
    script.write_text(
        "#!/usr/bin/python3\n"
        "import rospy\n"
        "rospy.init_node('real')\n"
        "rate = rospy.Rate(20)\n"
        "while not rospy.is_shutdown():\n"
        "    rospy.logwarn('from rospy')\n"
        "    rate.sleep()\n"
    )
    script.chmod(0o755)
    async with machine.engine():
        await machine.put(BOX, nodes=(NodeSpec(tag="node", pkg="sys", exe="tell.py"),))
        text = await holds(machine, "node", "from rospy", LogStream.ROSOUT, level=LogLevel.WARN)
        assert text.startswith("[WARN] [")
        await holds(machine, "", "WARN /real [", LogStream.ROSOUT)


async def test_a_killed_node_says_by_what(machine: Machine) -> None:
    async with machine.engine():
        await machine.put(BOX, nodes=(own("talk.py"),))
        await machine.log_holds(BOX, "node", "hello")
        os.kill(await machine.node_pid(BOX, "node"), signal.SIGSEGV)
        await machine.node_is(BOX, "node", NodeState.FAILED)
        text = (await read(machine, "node", LogStream.ENGINE)).text
        assert text.startswith("-- ended: killed by SIGSEGV")


async def test_logs_outlive_their_container(machine: Machine) -> None:
    async with machine.engine():
        await machine.put(BOX, nodes=(own("talk.py", "one"),))
        await machine.log_holds(BOX, "node", "hello one")
        first = machine.reported(BOX).incarnation
        machine.note_processes()
        os.kill(machine.environment().pid, signal.SIGKILL)
        await until(lambda: machine.reported(BOX).incarnation not in ("", first))
        await machine.log_holds(BOX, "node", "hello one")
        before = await read(machine, "node", previous=True)
        assert (before.incarnation, "hello one" in before.text) == (first, True)
        assert before.ended > 0
        assert "its environment died" in before.reason
        machine.told.clear()
        await machine.drop(BOX)
        after = await read(machine, "node")
        assert after.incarnation not in ("", first)
        assert "hello one" in after.text
        assert after.text.endswith("-- ended: it was told to by SIGINT --\n")
        assert (await read(machine, "node", incarnation=first)).text == before.text
        assert "no logs" in (await read(machine, "node", id_="another/box")).error
        machine.check_clean()


async def test_logs_outlive_killed_manager_and_unseen_end(
    machine: Machine,
) -> None:
    """Logs outlive a manager that is killed and a container that nobody saw end."""
    async with machine.managed(grace=0.5):
        await machine.put(BOX, nodes=(own("talk.py"),))
        await machine.log_holds(BOX, "node", "hello")
        machine.note_processes()
    await until(lambda: not machine.left(), timeout=40, what=machine.left)
    async with machine.engine():
        chunk = await read(machine, "node")
        assert "hello" in chunk.text
        assert "no manager saw it end; its last output" in chunk.reason
        assert "no manager for 0.5 s" in chunk.reason


async def test_the_logs_of_what_could_not_be_made_say_so(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rce_container.exceptions import StartError

    def refuse(*_: object) -> None:
        raise StartError("the disk is full")

    async with machine.engine():
        with monkeypatch.context() as patch:
            patch.setattr(type(machine.runtime), "start", refuse)
            await machine.put(BOX)
            faults = await until(lambda: machine.faults, what="a fault")
            assert "the disk is full" in faults[0]
            for record in (machine.folder / "state" / "logs" / BOX).glob("*.json"):
                assert "cannot be started: the disk is full" in record.read_text()
