"""The types of relayed topics and services: names and checksums, from connection headers."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast
from urllib.parse import urlsplit

from rce.ros.dialing import open_peer_socket
from rce.ros.errors import TcprosError, XmlRpcError
from rce.ros.multimaster.errors import NothingToRelayError
from rce.ros.tcpros.address import ask_address
from rce.ros.tcpros.header import ANY, MAX_HEADER, decode_header, encode_header, raise_error_field
from rce.ros.xmlrpc import RpcClient

if TYPE_CHECKING:
    from rce.ros.types import MessageType, ServiceType

PROBE_TIMEOUT = 5.0
_LENGTH = 4


@dataclass(frozen=True, slots=True)
class TopicKind:
    """A topic's type, as its publisher gives it."""

    name: str
    md5sum: str
    definition: str

    def as_type(self) -> MessageType:
        """Return the type for publishing and subscribing to serialized messages."""
        return cast("MessageType", self)


@dataclass(frozen=True, slots=True)
class _Named:
    name: str


@dataclass(frozen=True, slots=True)
class ServiceKind:
    """A service's type, as its provider gives it."""

    name: str
    md5sum: str
    request_type: str
    response_type: str

    @property
    def request(self) -> _Named:
        """The request's type, by name."""
        return _Named(self.request_type)

    @property
    def response(self) -> _Named:
        """The response's type, by name."""
        return _Named(self.response_type)

    def as_type(self) -> ServiceType:
        """Return the type for providing and calling serialized services."""
        return cast("ServiceType", self)


async def learn_topic(rpc: RpcClient, caller: str, topic: str, publishers: Iterable[str]) -> TopicKind:
    """Ask a topic's publishers for its type; the first that answers counts.

    Args:
        rpc: Asks for their addresses.
        caller: Name of the asking node.
        topic: The topic.
        publishers: URIs of the publishers' APIs.

    Raises:
        NothingToRelayError: None of them answers.
    """
    reason = "it has no publisher"
    for uri in publishers:
        try:
            async with asyncio.timeout(PROBE_TIMEOUT):
                host, port = await ask_address(rpc, uri, topic, caller)
                fields = await _greet(
                    host, port, {"callerid": caller, "topic": topic, "type": ANY, "md5sum": ANY}
                )
            return TopicKind(fields["type"], fields["md5sum"], fields.get("message_definition", ""))
        except (TcprosError, XmlRpcError, OSError, EOFError, KeyError, ValueError, OverflowError) as error:
            reason = f"{uri}: {str(error) or type(error).__name__}"
    raise NothingToRelayError(f"the type of {topic} cannot be learned: {reason}")


async def learn_service(caller: str, service: str, uri: str) -> ServiceKind:
    """Ask a service's provider for its type.

    Args:
        caller: Name of the asking node.
        service: The service.
        uri: The provider's ``rosrpc`` URI.

    Raises:
        NothingToRelayError: It does not answer.
    """
    header = {"callerid": caller, "service": service, "md5sum": ANY, "probe": "1"}
    try:
        async with asyncio.timeout(PROBE_TIMEOUT):
            fields = await _greet(*_service_address(uri), header)
        name = fields["type"]
        return ServiceKind(
            name,
            fields["md5sum"],
            fields.get("request_type", f"{name}Request"),
            fields.get("response_type", f"{name}Response"),
        )
    except (TcprosError, OSError, EOFError, KeyError, ValueError, OverflowError) as error:
        reason = str(error) or type(error).__name__
        raise NothingToRelayError(
            f"the type of service {service} cannot be learned: {uri}: {reason}"
        ) from error


def _service_address(uri: str) -> tuple[str, int]:
    parts = urlsplit(uri)
    if not parts.hostname or not parts.port:
        raise TcprosError("not a URI of the form rosrpc://host:port")
    return parts.hostname, parts.port


async def _greet(host: str, port: int, header: Mapping[str, str]) -> dict[str, str]:
    """Exchange connection headers and hang up."""
    reader, writer = await asyncio.open_connection(sock=await open_peer_socket(host, port))
    try:
        writer.write(encode_header(header))
        length = int.from_bytes(await reader.readexactly(_LENGTH), "little")
        if length > MAX_HEADER:
            raise TcprosError(f"a connection header of {length} bytes")
        fields = decode_header(await reader.readexactly(length))
    finally:
        writer.transport.abort()
    raise_error_field(fields)
    return fields
