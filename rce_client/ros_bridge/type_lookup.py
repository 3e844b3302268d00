"""Reads missing types of bridges from the robot's ROS graph."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, assert_never

from rce.config import ConfigError, Fault
from rce.config.bridges import Bridge, action_of
from rce.ros.errors import RosError, ToolError
from rce.ros.node.master import MasterClient
from rce.ros.tools.graph import service_type
from rce.ros.xmlrpc import RpcClient

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rce.ros.node import Node

TIMEOUT_S = 10.0
"""Seconds to wait for the robot's nodes."""
_LOOK_S = 0.5
_UNKNOWN = "*"


async def find_types(
    bridges: Mapping[int, Bridge],
    node: Node,
    source: str,
    say: Callable[[str], None],
    *,
    timeout: float = TIMEOUT_S,
) -> dict[int, str]:
    """Wait until the robot's graph has the types of all bridges.

    Args:
        bridges: Bridges without a type, by their index in the file.
        node: A node of the robot's graph.
        source: Name of the file, for errors.
        say: Prints a line for the user.
        timeout: Seconds to wait.

    Raises:
        ConfigError: A bridge has no end in the robot's graph, or its type was not found in time; every such
            bridge is named.
    """
    if faults := [
        Fault(f"bridges[{index}].type", f"is missing; {bridge} has no end at the robot to read it from")
        for index, bridge in bridges.items()
        if bridge.robot_name is None
    ]:
        raise ConfigError(source, faults)
    found: dict[int, str] = {}
    async with RpcClient() as rpc:
        master = MasterClient(node.master_uri, node.name, node.uri, rpc)
        try:
            async with asyncio.timeout(timeout):
                told = False
                while True:
                    await _look(bridges, master, found)
                    missing = [str(bridge) for index, bridge in bridges.items() if index not in found]
                    if not missing:
                        return found
                    if not told:
                        say(f"waiting for the types of {', '.join(missing)}")
                        told = True
                    await asyncio.sleep(_LOOK_S)
        except TimeoutError:
            left = [item for item in bridges.items() if item[0] not in found]
            raise ConfigError(source, [_timeout_fault(*item, timeout) for item in left]) from None


def _timeout_fault(index: int, bridge: Bridge, timeout: float) -> Fault:
    where = f"no node of the robot's graph had the type of {bridge} within {timeout:g} s"
    return Fault(f"bridges[{index}].type", f"is missing, and {where}; start the node first, or give the type")


async def _look(bridges: Mapping[int, Bridge], master: MasterClient, found: dict[int, str]) -> None:
    """Set the types that the graph has now."""
    topics = {name: type_ for name, type_ in await master.call("getTopicTypes") if type_ != _UNKNOWN}
    for index, bridge in bridges.items():
        if index not in found and (type_ := await _type_of(bridge, topics, master)):
            found[index] = type_


async def _type_of(bridge: Bridge, topics: Mapping[str, str], master: MasterClient) -> str | None:
    name = f"/{(bridge.robot_name or '').lstrip('/')}"
    match bridge.kind:
        case "topic":
            return topics.get(name)
        case "action":
            return action_of(topics.get(f"{name}/goal", ""))
        case "service":
            try:
                return await service_type(name, master)
            except (ToolError, RosError):  # not there yet, or it does not answer: keep waiting
                return None
        case _:
            assert_never(bridge.kind)
