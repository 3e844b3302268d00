"""A graph as its master knows it, and the types that publishers and services report."""

from __future__ import annotations

import asyncio
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from rce.dialing import open_socket
from rce.ros.errors import RosError, TcprosError, ToolError
from rce.ros.tcpros.address import ask_address
from rce.ros.tcpros.header import ANY, MAX_HEADER, decode_header, encode_header, raise_error_field
from rce.ros.types.exceptions import TypesError

if TYPE_CHECKING:
    from rce.ros.node.master import MasterClient
    from rce.ros.types import MessageType, TypeRegistry
    from rce.ros.xmlrpc import RpcClient

CONNECT_S = 5.0


@dataclass(frozen=True, slots=True)
class Graph:
    """A graph at one moment; names map to nodes."""

    publishers: dict[str, list[str]]
    subscribers: dict[str, list[str]]
    services: dict[str, list[str]]
    types: dict[str, str]
    """Of topics."""

    @property
    def topics(self) -> list[str]:
        """All topics, sorted."""
        return sorted(self.publishers.keys() | self.subscribers.keys())

    def type_of(self, topic: str) -> str:
        """Return a topic's type.

        Raises:
            ToolError: The master does not know it.
        """
        kind = self.types.get(topic, ANY)
        if kind == ANY:
            known = (
                "no node publishes it or subscribes to it"
                if topic not in self.topics
                else "its type is not known"
            )
            raise ToolError(f"topic {topic}: {known}; 'topic list' shows the topics of this graph")
        return kind


async def look(master: MasterClient) -> Graph:
    """Ask a master for its graph.

    Raises:
        MasterError: It does not answer.
    """
    publishers, subscribers, services = await master.call("getSystemState")
    types = await master.call("getTopicTypes")
    return Graph(
        {topic: sorted(nodes) for topic, nodes in publishers},
        {topic: sorted(nodes) for topic, nodes in subscribers},
        {service: sorted(nodes) for service, nodes in services},
        dict(types),
    )


async def message_type(
    topic: str, graph: Graph, master: MasterClient, rpc: RpcClient, types: TypeRegistry
) -> MessageType:
    """Find the type of a topic's messages: among the packages, or else as a publisher describes it.

    Raises:
        ToolError: The topic's type cannot be found out.
    """
    name = graph.type_of(topic)
    try:
        return types.message(name)
    except TypesError as error:
        for node in graph.publishers.get(topic, []):
            text = await _definition(topic, node, master, rpc)
            if text:
                return types.from_definition(name, text)
        raise ToolError(f"topic {topic}: {error}; and no publisher describes its type") from error


async def service_type(name: str, master: MasterClient) -> str:
    """Ask a service's provider for the service's type.

    Raises:
        ToolError: The service does not exist, or its provider does not answer.
    """
    uri = await master.lookup_service(name)
    if uri is None:
        raise ToolError(
            f"no node provides the service {name}; 'service list' shows the services of this graph"
        )
    probe = {"callerid": master.caller, "service": name, "md5sum": ANY, "probe": "1"}
    try:
        place = urlsplit(uri)
        fields = await _exchange_headers(place.hostname or "", place.port or 0, probe)
        return fields["type"]
    except (OSError, TimeoutError, EOFError, TcprosError, KeyError, ValueError) as error:
        raise ToolError(f"the provider of {name} at {uri} does not answer: {error}") from error


async def _definition(topic: str, node: str, master: MasterClient, rpc: RpcClient) -> str:
    """Ask a publisher for the text of its topic's type; empty if it does not send it."""
    uri = await master.lookup_node(node)
    if uri is None:
        return ""
    try:
        host, port = await ask_address(rpc, uri, topic, master.caller)
        fields = {"callerid": master.caller, "topic": topic, "type": ANY, "md5sum": ANY}
        return (await _exchange_headers(host, port, fields)).get("message_definition", "")
    except (RosError, OSError, TimeoutError, EOFError, ValueError):
        return ""


async def _exchange_headers(host: str, port: int, fields: dict[str, str]) -> dict[str, str]:
    """Connect, send a connection header, and return the other end's."""
    async with asyncio.timeout(CONNECT_S):
        reader, writer = await asyncio.open_connection(sock=await open_socket(host, port))
        try:
            writer.write(encode_header(fields))
            (size,) = struct.unpack("<I", await reader.readexactly(4))
            if size > MAX_HEADER:
                raise TcprosError(f"a connection header of {size} bytes")
            answer = decode_header(await reader.readexactly(size))
            raise_error_field(answer)
            return dict(answer)
        finally:
            writer.close()
