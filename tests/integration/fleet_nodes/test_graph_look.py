"""Searches for robots in a ROS graph: they find topics, and become rarer in large graphs."""

from __future__ import annotations

from rce.ros.core import Core
from rce.ros.multimaster.source import multicall
from rce.ros.node import Node
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient
from rce_fleet.nodes.graph_look import CHANGING, TOPICS_PER_S, GraphLook

MANY = 2000


async def test_large_graphs_are_looked_at_less_often() -> None:
    async with (
        Core(port=0) as core,
        Node("searcher", argv=[], master_uri=core.uri) as node,
        RpcClient() as rpc,
        GraphLook(node, 0.5) as graph,
    ):
        await node.advertise("/Robot1/amcl_pose", "std_msgs/String")
        topics = await graph.look()
        assert topics.publishers["/Robot1/amcl_pose"] == [node.name]
        assert "/Robot1/amcl_pose" not in topics.subscribers
        assert 0.5 < graph.pause < 0.6
        other = MasterClient(core.uri, "/other", "http://127.0.0.1:9/", rpc)
        calls = [
            ("registerPublisher", f"/Robot{number}/scan", "std_msgs/String", other.slave_uri)
            for number in range(MANY)
        ]
        await multicall(other, calls)
        assert (await graph.look()).publishers[f"/Robot{MANY - 1}/scan"] == ["/other"]
        assert (
            graph.pause < 0.6 + MANY / TOPICS_PER_S / CHANGING
        )  # robots come together, and wait for the next look
        await graph.look()
        assert graph.pause > 0.5 + MANY / TOPICS_PER_S
