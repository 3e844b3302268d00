"""Our core and our nodes answer calls, right and wrong ones, as real ones do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support.ports import free_port
from support.ros_nodes import MakeGraphNode
from support.ros_real import Graph

from rce.ros.core import Core
from rce.ros.errors import RemoteFaultError
from rce.ros.xmlrpc import RpcClient

pytestmark = [pytest.mark.needs("rospy", "roslaunch")]

STRING = "std_msgs/String"
SLAVE = "http://127.0.0.1:1/"

MASTER_CALLS: list[tuple[str, tuple[Any, ...]]] = [
    ("getPid", ("/a",)),
    ("getUri", ("/a",)),
    ("getPid", ()),
    ("getPid", ("/a", 1)),
    ("registerPublisher", ("/a", "/t", STRING, SLAVE)),
    ("registerPublisher", ("/a", "rel", STRING, SLAVE)),
    ("registerPublisher", ("/a", "/t", "no_slash", SLAVE)),
    ("registerPublisher", ("/a", "/t", STRING, "no uri")),
    ("registerPublisher", ("/a", "", STRING, SLAVE)),
    ("registerPublisher", ("/a", 5, STRING, SLAVE)),
    ("registerPublisher", ("/a", "/t", STRING)),
    ("registerSubscriber", ("/b", "/t", "*", "http://127.0.0.1:2/")),
    ("registerSubscriber", ("/b", "/u", STRING, "http://127.0.0.1:2/")),
    ("registerService", ("/a", "/s", "rosrpc://127.0.0.1:3", SLAVE)),
    ("registerService", ("/a", "/s", "http://127.0.0.1:3", SLAVE)),
    ("lookupNode", ("/x", "/a")),
    ("lookupNode", ("/x", "/nobody")),
    ("lookupNode", ("/x", "a")),
    ("lookupService", ("/x", "/s")),
    ("lookupService", ("/x", "/nothing")),
    ("getPublishedTopics", ("/x", "")),
    ("getPublishedTopics", ("/x", "/ns")),
    ("getTopicTypes", ("/x",)),
    ("getSystemState", ("/x",)),
    ("unregisterService", ("/a", "/s", "rosrpc://127.0.0.1:9")),
    ("unregisterService", ("/a", "/s", "rosrpc://127.0.0.1:3")),
    ("unregisterSubscriber", ("/b", "/u", "http://127.0.0.1:2/")),
    ("unregisterSubscriber", ("/b", "/u", "http://127.0.0.1:2/")),
    ("unregisterPublisher", ("/a", "/t", "http://127.0.0.1:9/")),
    ("unregisterPublisher", ("/a", "/t", SLAVE)),
    ("getParam", ("/x", "/nothing")),
    ("setParam", ("/ns/x", "rel", {"a": 1, "b": {"c": [1, 2.5, "x", True]}})),
    ("setParam", ("/x", "", 1)),
    ("setParam", ("/x", "/p", "text")),
    ("setParam", ("/x", "/p/below", 1)),
    ("getParam", ("/x", "/p")),
    ("getParam", ("/x", "/ns/rel/b/c")),
    ("getParam", ("/ns/x", "rel/b")),
    ("getParam", ("/x", "/ns/")),
    ("hasParam", ("/x", "/ns/rel")),
    ("hasParam", ("/x", "/nothing")),
    ("searchParam", ("/ns/deep/x", "rel")),
    ("searchParam", ("/ns/deep/x", "rel/b/zzz")),
    ("searchParam", ("/ns/deep/x", "nothing")),
    ("searchParam", ("/ns/deep/x", "~private")),
    ("searchParam", ("/ns/x", "/ns/rel")),
    ("subscribeParam", ("/b", "http://127.0.0.1:2/", "/ns/rel/a")),
    ("subscribeParam", ("/b", "http://127.0.0.1:2/", "/nothing")),
    ("unsubscribeParam", ("/b", "http://127.0.0.1:2/", "/nothing")),
    ("deleteParam", ("/x", "/ns/rel/b")),
    ("deleteParam", ("/x", "/nothing")),
    ("getParamNames", ("/x",)),
    ("noSuchMethod", ("/x",)),
]

OWN = ("/run_id", "/rosdistro", "/rosversion", "/roslaunch/")
"""Parameters of the core itself."""


def comparable(method: str, answer: Any) -> Any:
    """Leave out what may differ: texts, values of failures, ids of processes, the cores' own parameters."""
    status, _, value = answer
    if status != 1:
        return "refused", status
    if method in ("getPid", "getName", "getUri", "getMasterUri"):
        return status, type(value)
    if method == "getParamNames":
        return status, sorted(name for name in value if not name.startswith(OWN))
    if method == "getSystemState":
        return status, [sorted(part) for part in value]
    if method in ("getTopicTypes", "getPublishedTopics"):
        return status, sorted(value)
    return status, value


async def play(uri: str, calls: list[tuple[str, tuple[Any, ...]]]) -> list[Any]:
    found = []
    async with RpcClient() as rpc:
        for method, arguments in calls:
            try:
                found.append(comparable(method, await rpc.call(uri, method, arguments)))
            except RemoteFaultError:
                found.append("fault")
    return found


async def test_the_core_answers_as_a_real_one(tmp_path: Path) -> None:
    port = free_port()
    real = Graph(f"http://127.0.0.1:{port}/", tmp_path, "rosmaster")
    async with real.program("/usr/bin/rosmaster", "--core", "-p", str(port)), Core(port=0) as ours:
        await real.until(lambda: real.ask("getPid"), what="rosmaster is up")
        expected, found = await play(real.uri, MASTER_CALLS), await play(ours.uri, MASTER_CALLS)
    differences = [
        (call, theirs, mine)
        for call, theirs, mine in zip(MASTER_CALLS, expected, found, strict=True)
        if theirs != mine
    ]
    assert differences == [], "\n".join(map(str, differences))


ENTRIES: tuple[object, ...] = (
    "",
    "nothing",
    "host:1234",
    "/path",
    "http://",
    "http:/host",
    "//host:1",
    "://host",
    7,
    [],
)

SLAVE_CALLS: list[tuple[str, tuple[Any, ...]]] = [
    ("getPid", ("/x",)),
    ("getName", ("/x",)),
    ("getUri", ("/x",)),
    ("getMasterUri", ("/x",)),
    ("requestTopic", ("/x", "/nothing", [["TCPROS"]])),
    ("requestTopic", ("/x", "/peer_out", [["UNKNOWN"]])),
    ("requestTopic", ("/x", "/peer_out", "TCPROS")),
    ("publisherUpdate", ("/master", "/nothing", [])),
    ("publisherUpdate", ("/master", "/peer_in", "no list")),
    *(("publisherUpdate", ("/master", "/peer_in", [entry])) for entry in ENTRIES),
    ("publisherUpdate", ("/master", "/peer_in", ["http://127.0.0.1:1/", "nothing"])),
    ("publisherUpdate", ("/master", "/peer_in", ["any://127.0.0.1:1"])),
    ("publisherUpdate", ("/master", "/peer_in", {})),
    ("publisherUpdate", ("/master", "", [])),
    ("publisherUpdate", ("/master", 7, [])),
    ("publisherUpdate", ("/master", "a b", [])),
    ("publisherUpdate", ("/master", "/peer_in")),
    ("publisherUpdate", (7, "/peer_in", [])),
    ("requestTopic", ("/x", "/peer_out", [])),
    ("requestTopic", ("/x", "/peer_out", {})),
    ("requestTopic", ("/x", "", [["TCPROS"]])),
    ("requestTopic", ("/x", 7, [["TCPROS"]])),
    ("requestTopic", ("/x", "/peer_out", [[]])),
    ("requestTopic", ("/x", "/peer_out", [7])),
    ("requestTopic", ("/x", "/peer_out", 7)),
    ("paramUpdate", ("/master", "/p", 1)),
    ("paramUpdate", ("/master", "", 1)),
    ("getBusStats", ()),
    ("noSuchMethod", ("/x",)),
]


async def test_a_node_answers_as_a_real_one(
    ours: Graph, make_node: MakeGraphNode, rospy_peer: tuple[str, str]
) -> None:
    async with make_node(ours, "mine") as node, ours.program(*rospy_peer):
        await ours.until(lambda: ours.service("/peer_ask"), what="the rospy node is up")
        real = await ours.node("/rospy_peer")
        assert real is not None
        await node.advertise("/peer_out", STRING)
        await node.subscribe("/peer_in", STRING)
        expected, found = await play(real, SLAVE_CALLS), await play(node.uri, SLAVE_CALLS)
    differences = [
        (call, theirs, mine)
        for call, theirs, mine in zip(SLAVE_CALLS, expected, found, strict=True)
        if theirs != mine
    ]
    assert differences == [], "\n".join(map(str, differences))
