"""What the nodes of ROS graphs say of the messages they received."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterable
from typing import Any

from rce.ros.errors import MasterError, XmlRpcError
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient
from rce_fleet.demo.counters import Counters
from rce_fleet.demo.exceptions import DemoError

CALLER = "/rce_demo"
TIMEOUT = 5.0
"""Seconds for one question."""


async def read_bus(cores: Iterable[str], nodes: Collection[str]) -> Counters:
    """Sum up what nodes received over connections that they have now.

    ROS's ``getBusStats`` does not tell how many messages were dropped.

    Args:
        cores: URIs of the ROS masters at which the nodes are registered.
        nodes: Global names of the nodes; one that is registered at several masters is asked once.

    Raises:
        DemoError: A master or a node does not answer.
    """
    try:
        async with RpcClient() as rpc:
            found: set[str] = set()
            for core in cores:
                found.update(await _apis(MasterClient(core, CALLER, "", rpc, TIMEOUT), nodes))
            asking = (rpc.call(api, "getBusStats", (CALLER,), timeout=TIMEOUT) for api in sorted(found))
            return Counters(messages=sum(map(received, await asyncio.gather(*asking))), dropped=None)
    except (MasterError, XmlRpcError) as error:
        raise DemoError(f"the nodes do not say what they received: {error}") from error


def received(answer: Any) -> int:
    """The number of received messages in an answer to ``getBusStats``."""
    _, subscriptions, _ = answer[2]
    return sum(connection[2] for _, connections in subscriptions for connection in connections)


async def _apis(master: MasterClient, nodes: Collection[str]) -> set[str]:
    """URIs of those of the nodes that a master knows."""
    state = await master.call("getSystemState")
    known = {name for kind in state for _, names in kind for name in names}
    return {str(await master.call("lookupNode", name)) for name in known.intersection(nodes)}
