"""The requests that a client makes of the engine, as methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from rce.protocol.messages import (
    AddInterface,
    AddNode,
    ConfigureComponents,
    ConfigureConnections,
    Connection,
    ContainerData,
    CreateContainer,
    DeleteParam,
    DestroyContainer,
    RemoveInterface,
    RemoveNode,
    ResizeContainer,
    ResizeData,
    SetParam,
)

if TYPE_CHECKING:
    from rce.protocol.messages import Quantity, Request, Value


class Requests(ABC):
    """Containers and what is in them; interfaces and connections of all endpoints of the user."""

    @abstractmethod
    async def request(self, request: Request) -> None:
        """Send a request."""

    async def create_container(self, tag: str, **resources: Any) -> None:
        """Make a container; ``resources`` are fields of :class:`rce.protocol.messages.ContainerData`."""
        await self.request(CreateContainer(container_tag=tag, container_data=ContainerData(**resources)))

    async def resize_container(
        self,
        tag: str,
        *,
        size: int | None = None,
        cpu: Quantity | None = None,
        memory: Quantity | None = None,
        bandwidth: Quantity | None = None,
    ) -> None:
        """Change what a container may use, while it runs.

        What is not given stays as it is; zero withdraws a request. If its machine has no room for it, an
        error text says so and nothing changes.

        Args:
            tag: The container's.
            size: Slots.
            cpu: Cores, or a text such as ``"50%"``.
            memory: MB, or a text such as ``"256M"``.
            bandwidth: Bytes per second, or a text such as ``"10Mbit"``.
        """
        data = ResizeData(size=size, cpu=cpu, memory=memory, bandwidth=bandwidth)
        await self.request(ResizeContainer(container_tag=tag, container_data=data))

    async def destroy_container(self, tag: str) -> None:
        """Remove a container and all that is in it."""
        await self.request(DestroyContainer(container_tag=tag))

    async def add_node(
        self,
        container: str,
        tag: str,
        pkg: str,
        exe: str,
        *,
        args: str = "",
        name: str = "",
        namespace: str = "",
        **life: Any,
    ) -> None:
        """Start a node.

        ``life`` are further fields of :class:`rce.protocol.messages.AddNode`: ``restart="on-failure"``, ...
        """
        node = AddNode(
            container_tag=container,
            node_tag=tag,
            pkg=pkg,
            exe=exe,
            args=args,
            name=name,
            namespace=namespace,
            **life,
        )
        await self.request(ConfigureComponents(add_nodes=(node,)))

    async def remove_node(self, container: str, tag: str) -> None:
        """Stop a node."""
        node = RemoveNode(container_tag=container, node_tag=tag)
        await self.request(ConfigureComponents(remove_nodes=(node,)))

    async def set_parameter(self, container: str, name: str, value: Value) -> None:
        """Set a parameter of a container."""
        parameter = SetParam(container_tag=container, name=name, value=value)
        await self.request(ConfigureComponents(set_param=(parameter,)))

    async def delete_parameter(self, container: str, name: str) -> None:
        """Delete a parameter of a container."""
        parameter = DeleteParam(container_tag=container, name=name)
        await self.request(ConfigureComponents(delete_param=(parameter,)))

    async def add_interface(self, endpoint: str, tag: str, type: str, cls: str, *, addr: str = "") -> None:  # noqa: A002
        """Make an interface of a container or a robot; ``addr`` is its ROS name at a container's end."""
        interface = AddInterface(
            endpoint_tag=endpoint, interface_tag=tag, interface_type=type, message_type=cls, addr=addr
        )
        await self.request(ConfigureComponents(add_interfaces=(interface,)))

    async def remove_interface(self, endpoint: str, tag: str) -> None:
        """Remove an interface and its connections."""
        interface = RemoveInterface(endpoint_tag=endpoint, interface_tag=tag)
        await self.request(ConfigureComponents(remove_interfaces=(interface,)))

    async def connect(self, a: str, b: str) -> None:
        """Join two interfaces, each written ``ENDPOINT/INTERFACE``."""
        await self.request(ConfigureConnections(connect=(Connection(tag_a=a, tag_b=b),)))

    async def disconnect(self, a: str, b: str) -> None:
        """Part two interfaces."""
        await self.request(ConfigureConnections(disconnect=(Connection(tag_a=a, tag_b=b),)))
