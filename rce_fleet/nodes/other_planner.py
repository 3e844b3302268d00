"""Keeps two planners from driving one fleet: the second stands by until the first has ended."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from rce.ros.errors import MasterError
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient

if TYPE_CHECKING:
    from rce.ros.node import Node

SERVICE = "/fleet/set_goal"
"""Every planner provides this service."""
_LOOK_EVERY = 1.0
"""Seconds between two looks for another planner."""
_PROBE_S = 2.0
"""Seconds in which a running planner accepts a connection."""


async def stand_by(node: Node) -> bool:
    """Wait while another planner serves this ROS graph.

    The registration of a planner that was killed stays at the master; so the service's address is tried too.

    Args:
        node: Running node, before it provides services.

    Returns:
        Whether to go on; False if the node was stopped meanwhile.
    """
    is_told = False
    async with RpcClient() as rpc:
        master = MasterClient(node.master_uri, node.name, node.uri, rpc)
        while True:
            address = await _service_address(master)
            if not address or not await _answers(address):
                break
            if not is_told:
                node.log.error(
                    "another planner serves this fleet (%s at %s): this one stands by until it ends",
                    SERVICE,
                    address,
                )
                is_told = True
            if not await node.sleep(_LOOK_EVERY):
                return False
    if is_told:
        node.log.warning("the other planner has ended: this one takes over")
    return not node.is_shutdown


async def _service_address(master: MasterClient) -> str:
    """Return the address of the service's provider; empty without one."""
    try:
        return str(await master.call("lookupService", SERVICE))
    except MasterError:
        return ""


async def _answers(address: str) -> bool:
    """Return whether something accepts connections at an address such as ``rosrpc://host:port``."""
    place = urlsplit(address)
    if place.hostname is None or place.port is None:
        return False
    try:
        async with asyncio.timeout(_PROBE_S):
            _, writer = await asyncio.open_connection(place.hostname, place.port)
    except (OSError, TimeoutError):
        return False
    writer.close()
    return True
