"""A container's graph in ROS 1: its own core, and the environment's node in it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING

from rce.ros.core import Core
from rce.ros.core.events import Change
from rce.ros.core.rosout import AGGREGATE
from rce.ros.logrecord import KIND, MD5SUM
from rce.ros.node import Node, RosError, TypeRegistry
from rce.ros.node.runtime import TypeName
from rce.ros.node.settings import is_loopback
from rce.ros.tcpros.header import ANY
from rce.ros.xmlrpc import RpcClient
from rce_container.environment.graph import GraphError, NodeListener, Subscription
from rce_container.environment.interfaces import InterfaceMaker, Readiness
from rce_container.environment.nodes.launch import OWN_NODE

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping

    from rce.link import Interface, Port
    from rce.model import ParameterValue
    from rce.ros.packages import PackageIndex

_log = logging.getLogger(__name__)

_GET_PID_TIMEOUT_S = 5.0
SAVE_STATE = "rce_msgs/SaveState"
RESTORE_STATE = "rce_msgs/RestoreState"
"""Both have one field, ``uint8[] data``: its length in four bytes, then the bytes."""
_LENGTH = 4


class Ros1Graph:
    """The graph of a container. Implements :class:`rce_container.environment.graph.Graph`.

    Args:
        core: The container's ROS core.
        node: The environment's node.
        types: Knows the messages' and services' types.
        address: Where nodes are reached.
        settling: Whether nodes are starting, or soon will, and may yet register topics and services.
    """

    def __init__(
        self, core: Core, node: Node, types: TypeRegistry, address: str, settling: Callable[[], bool]
    ) -> None:
        self._core = core
        self._node = node
        self._address = address
        self._make = InterfaceMaker(node, types, Readiness(settling))

    @property
    def variables(self) -> Mapping[str, str]:
        """Environment variables by which nodes find the graph."""
        return {"ROS_MASTER_URI": self._core.uri, "ROS_IP": self._address}

    def make_interface(self, port: Port) -> Interface:
        """Make a topic or service of the graph.

        Raises:
            InterfaceError: The port's spec cannot be fulfilled; the text says what to do.
        """
        return self._make(port)

    def set_parameter(self, name: str, value: ParameterValue) -> None:
        """Set a parameter."""
        self._core.set_param(name, value)

    def delete_parameter(self, name: str) -> None:
        """Delete a parameter that was set."""
        self._core.delete_param(name)

    async def listen(self, topic: str, on_message: Callable[[], None]) -> Subscription:
        """Call ``on_message`` for each message of a topic, of any type.

        Raises:
            GraphError: The topic cannot be listened to.
        """
        try:
            return await self._node.subscribe_serialized(topic, ANY, lambda *_: on_message())
        except RosError as error:
            raise GraphError(str(error)) from error

    async def wait_for_service(self, service: str, timeout: float) -> None:
        """Wait until a service answers.

        Raises:
            GraphError: None does within ``timeout`` seconds.
        """
        try:
            await self._node.wait_for_service(service, timeout=timeout)
        except TimeoutError:
            raise GraphError(f"service {service} was not there within {timeout:.0f} s") from None
        except RosError as error:
            raise GraphError(str(error)) from error

    async def save_state(self, service: str, timeout: float) -> bytes:
        """Ask a node for its state.

        Raises:
            GraphError: It did not give it within ``timeout`` seconds.
        """
        answer = await self._call(service, SAVE_STATE, b"", timeout)
        size = int.from_bytes(answer[:_LENGTH], "little")
        if len(answer) != _LENGTH + size:
            raise GraphError(f"service {service} answered with a wrong length")
        return answer[_LENGTH:]

    async def restore_state(self, service: str, state: bytes, timeout: float) -> None:
        """Give a node its state.

        Raises:
            GraphError: It did not take it within ``timeout`` seconds.
        """
        await self._call(service, RESTORE_STATE, len(state).to_bytes(_LENGTH, "little") + state, timeout)

    async def _call(self, service: str, service_type: str, request: bytes, timeout: float) -> bytes:
        try:
            client = self._node.service_client(service, service_type, persistent=False)
            try:
                return await client.call_serialized(request, timeout=timeout)
            finally:
                await client.close()
        except RosError as error:
            raise GraphError(str(error)) from error

    async def follow_records(self, take: Callable[[bytes, bool], None]) -> None:
        """Pass the records that nodes publish on ``/rosout`` to ``take``, as long as the graph lives."""
        await self._node.subscribe_serialized(AGGREGATE, TypeName(KIND, MD5SUM), take)

    async def watch_nodes(self, listener: NodeListener) -> None:
        """Report nodes that register, until cancelled."""
        with self._core.watch() as events:
            async with RpcClient() as client, asyncio.TaskGroup() as tasks:
                async for event in events:
                    if event.change is Change.NODE_APPEARED and not listener.node_appeared(event.node):
                        tasks.create_task(self._identify(client, event.node, listener), name="identify")

    async def _identify(self, client: RpcClient, name: str, listener: NodeListener) -> None:
        """Ask a node with an unknown name for its process."""
        uri = self._core.graph.node(name)
        if uri is None or name == f"/{OWN_NODE}":
            return
        try:
            _, _, pid = await client.call(uri, "getPid", (OWN_NODE,), timeout=_GET_PID_TIMEOUT_S)
            listener.node_identified(name, int(pid))
        except (RosError, TypeError, ValueError, OverflowError) as error:
            _log.info("node %s does not tell its process: %s", name, error)


@contextlib.asynccontextmanager
async def ros1_graph(
    address: str, port: int, packages: PackageIndex, settling: Callable[[], bool]
) -> AsyncIterator[Ros1Graph]:
    """Run the core and the environment's node.

    Args:
        address: Where the container's nodes are reached by others of its group; loopback if it has none.
        port: Of the core; 0 takes a free one.
        packages: Where types are found.
        settling: Whether nodes are starting, or soon will.
    """
    host = address if is_loopback(address) else "0.0.0.0"  # noqa: S104 - of the container's own network
    types = TypeRegistry(packages)
    async with (
        Core(host, port, advertised=address, rosout=True) as core,
        Node(OWN_NODE, argv=[f"__ip:={address}"], master_uri=core.uri, types=types) as node,
    ):
        yield Ros1Graph(core, node, types, address, settling)
