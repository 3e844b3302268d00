"""How many messages the engine's interfaces, or the nodes of ROS graphs, received."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

import aiohttp
from yarl import URL

from rce.masters import split_addresses
from rce.ros.errors import MasterError, XmlRpcError
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient
from rce_fleet.demo.exceptions import DemoError

HTTP_TIMEOUT = aiohttp.ClientTimeout(total=10)
CALLER = "/rce_demo"
CALL_TIMEOUT = 5.0
"""Seconds for one call of the ROS Master or Slave API."""


@dataclass(frozen=True, slots=True)
class MessageTotals:
    """Sums over all interfaces of the user, or over all nodes of ROS graphs.

    Attributes:
        messages: Messages received from peers.
        dropped: Messages dropped because a receiver was too slow; None if unknown.
    """

    messages: int
    dropped: int | None


async def read_engine_totals(masters: str, user: str, password: str) -> MessageTotals:
    """Read the totals of a user's interfaces from the engine's master.

    Args:
        masters: Its URL, or those of several, separated by commas; the first one that answers is used.
        user: User ID.
        password: The user's password.

    Raises:
        DemoError: No master answers as expected.
    """
    interfaces, problem = None, ""
    async with aiohttp.ClientSession(timeout=HTTP_TIMEOUT, raise_for_status=True) as session:
        for master in split_addresses(masters):
            try:
                interfaces = await _interfaces(session, URL(master) / "api/v1", user, password)
                break
            except (aiohttp.ClientError, TimeoutError, KeyError) as error:
                problem = str(error)
    if interfaces is None:
        raise DemoError(f"cannot read the message counters from the master: {problem}")
    return MessageTotals(
        messages=sum(interface["messages_in"] for interface in interfaces),
        dropped=sum(interface["dropped"] for interface in interfaces),
    )


async def read_graph_totals(cores: Iterable[str], nodes: Collection[str]) -> MessageTotals:
    """Sum up what nodes received over their current connections.

    ROS's ``getBusStats`` does not report dropped messages.

    Args:
        cores: URIs of the ROS masters at which the nodes are registered.
        nodes: Global names of the nodes; a node that is registered at several masters is asked once.

    Raises:
        DemoError: A master or a node does not answer.
    """
    try:
        async with RpcClient() as rpc:
            found: set[str] = set()
            for core in cores:
                found.update(await _node_uris(MasterClient(core, CALLER, "", rpc, CALL_TIMEOUT), nodes))
            calls = (rpc.call(uri, "getBusStats", (CALLER,), timeout=CALL_TIMEOUT) for uri in sorted(found))
            return MessageTotals(messages=sum(map(received, await asyncio.gather(*calls))), dropped=None)
    except (MasterError, XmlRpcError) as error:
        raise DemoError(f"cannot read the message counters from the nodes: {error}") from error


def received(answer: Any) -> int:
    """Return the number of received messages in an answer to ``getBusStats``."""
    _, subscriptions, _ = answer[2]
    return sum(connection[2] for _, connections in subscriptions for connection in connections)


async def _node_uris(master: MasterClient, nodes: Collection[str]) -> set[str]:
    """Return the URIs of those of the nodes that a master knows."""
    state = await master.call("getSystemState")
    known = {name for entries in state for _, names in entries for name in names}
    return {str(await master.call("lookupNode", name)) for name in known.intersection(nodes)}


async def _interfaces(
    session: aiohttp.ClientSession, api: URL, user: str, password: str
) -> list[dict[str, Any]]:
    login = {"userID": user, "password": password, "label": "rce demo"}
    async with session.post(api / "login", json=login) as reply:
        token = (await reply.json())["token"]
    headers = {"Authorization": f"Bearer {token}"}
    try:
        async with session.get(api / "interfaces", params={"user": user}, headers=headers) as reply:
            found: list[dict[str, Any]] = (await reply.json())["interfaces"]
            return found
    finally:
        async with session.delete(api / "login", headers=headers):
            pass  # only revokes the token
