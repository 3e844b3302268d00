"""State that all parts of one node share while it runs."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from rce.aio.tasks import TaskScope
from rce.ros.errors import NodeClosedError
from rce.ros.node.master import MasterClient
from rce.ros.node.registrations import Registrations
from rce.ros.xmlrpc import RpcClient

if TYPE_CHECKING:
    from rce.ros.types import MessageType, ServiceType, TypeRegistry


class TypeName(NamedTuple):
    """Name and checksum of a message type: enough to take serialized messages."""

    name: str
    md5sum: str


class Types:
    """The node's types, with the registry made when the first is needed: it is slow to import."""

    def __init__(self, registry: TypeRegistry | None) -> None:
        self._registry = registry

    @property
    def registry(self) -> TypeRegistry:
        """The source of types."""
        if self._registry is None:
            from rce.ros.types import TypeRegistry

            self._registry = TypeRegistry()
        return self._registry

    def message(self, message_type: str | MessageType) -> MessageType:
        """Return a message type by its name, or ``message_type`` if it is one."""
        return self.registry.message(message_type) if isinstance(message_type, str) else message_type

    def service(self, service_type: str | ServiceType) -> ServiceType:
        """Return a service type by its name, or ``service_type`` if it is one."""
        return self.registry.service(service_type) if isinstance(service_type, str) else service_type


@dataclass(slots=True)
class Runtime:
    """The shared state of a running node."""

    name: str
    """The node's global name."""
    types: Types
    tasks: TaskScope
    """Owns the node's background work."""
    rpc: RpcClient
    master: MasterClient
    registrations: Registrations
    scratch: memoryview
    """Read buffer of all TCPROS connections."""
    intra_process: bool
    """Whether messages of nodes in this process are taken as objects."""
    stopping: asyncio.Event
    """Set when the node is told to stop."""

    def check_running(self) -> None:
        """Check that the node continues: a wait that has no time limit would never end.

        Raises:
            NodeClosedError: It was told to stop.
        """
        if self.stopping.is_set():
            raise NodeClosedError(f"node {self.name} was told to stop")
