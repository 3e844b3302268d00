"""The requests that a client makes of the engine, as methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from rce.model import (
    AddInterface,
    AddNode,
    ConfigureComponents,
    ConfigureConnections,
    Connection,
    CreateContainer,
    DeleteParameter,
    DestroyContainer,
    InterfaceSpec,
    ParameterSpec,
    RemoveInterface,
    RemoveNode,
    Request,
    ResizeContainer,
    SetParameter,
)
from rce.model.spelling import PLAIN

if TYPE_CHECKING:
    from rce.model.written import NetworkName, Quantity, RestartName, Value


R = TypeVar("R", CreateContainer, ResizeContainer, AddNode)


class Requests(ABC):
    """Requests for containers and their contents, and for interfaces and connections of the user's endpoints.

    Each method sends one request. :meth:`request` describes when they return, which errors they raise, and
    that cancelling does not withdraw a request.
    """

    @abstractmethod
    async def request(self, request: Request) -> None:
        """Send a request."""

    # Containers

    async def create_container(
        self,
        tag: str,
        *,
        size: int = 1,
        cpu: Quantity = 0.0,
        memory: Quantity = 0,
        bandwidth: Quantity = 0,
        network: NetworkName = "",
        group: str = "",
        group_ip: str = "",
        image: str = "",
        special_features: Sequence[str] | str = (),
        volumes: Sequence[Mapping[str, Quantity]] = (),
        wait: bool = False,
    ) -> None:
        """Create a container. Zero and empty values are not requested.

        If the container exists with the same data, it is not changed. Cancelling does not withdraw the
        request.

        Args:
            tag: Name of the container, unique among the user's robots and containers.
            size: Slots of its machine, 1 to 65536; their share is used for resources that are not requested
                below.
            cpu: Processor cores: a number, or a text in percent of one core (``"50%"``).
            memory: MB (2^20 bytes): a number, or a text with a unit (``"256M"``, ``"1G"``, ``"512MiB"``); the
                prefixes are powers of 1024.
            bandwidth: Of all its links, in bytes per second: a number, or a text (``"5M"`` bytes,
                ``"10Mbit"``); the prefixes are powers of 1000, with an ``i`` of 1024.
            network: ``"none"``: its own loopback only; ``"group"``: also the containers of the same group;
                ``"host"``: the machine's own network, for administrators. By default ``"group"`` if
                ``group_ip`` is given, else ``"none"``.
            group: The group; its containers are placed on one machine if possible.
            group_ip: IPv4 address in the group's network, such as ``"10.0.0.2"`` (which means
                ``"10.0.0.2/24"``); a free one if empty.
            image: Root file system: an OCI image's name, or (administrators) the path of a folder.
            special_features: Labels that the machine must have: a sequence, or one text of words.
            volumes: Folders that outlive the container: ``{"name": "journal", "path": "/data", "size":
                "64M"}`` each. They are mounted read-write at ``path``; nodes also find it in the variable
                ``RCE_VOLUME_JOURNAL``. With ``"snapshots": 60``, a snapshot is kept every 60 s.
            wait: Wait if no machine has room; otherwise ``on_error`` gets an error text, and no container is
                created.

        Raises:
            ValueError: An argument is invalid; the text names it and the expected value.
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.create_container("brain", cpu="50%", memory="256M", wait=True)
            ```
        """
        await self.request(_read(CreateContainer, locals()))

    async def resize_container(
        self,
        tag: str,
        *,
        size: int | None = None,
        cpu: Quantity | None = None,
        memory: Quantity | None = None,
        bandwidth: Quantity | None = None,
    ) -> None:
        """Change the resources of a container while it runs.

        If its machine has no room, ``on_error`` gets an error text and nothing changes. Cancelling does not
        withdraw the request.

        Args:
            tag: The container.
            size: Slots, 1 to 65536; None leaves it as it is.
            cpu: Cores, as for :meth:`create_container`; None leaves it as it is, 0 withdraws the request.
            memory: MB, or a text such as ``"256M"``; None leaves it as it is, 0 withdraws the request.
            bandwidth: Bytes per second, or a text such as ``"10Mbit"``; None leaves it as it is, 0 withdraws
                the request.

        Raises:
            ValueError: An argument is invalid; the text names it and the expected value.
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.resize_container("brain", cpu=0.5, memory="512M")
            ```
        """
        await self.request(_read(ResizeContainer, locals()))

    async def destroy_container(self, tag: str) -> None:
        """Remove a container with its nodes, interfaces and connections.

        Cancelling does not withdraw the request.

        Args:
            tag: The container.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.destroy_container("brain")
            ```
        """
        await self.request(DestroyContainer(tag=tag))

    # Nodes and parameters

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
        restart: RestartName = "never",
        max_restarts: int = 5,
        after: Sequence[str] = (),
        heartbeat: str = "",
        heartbeat_timeout: float = 5.0,
        state_services: Mapping[str, str | float] | None = None,
    ) -> None:
        """Start a node. Cancelling does not withdraw the request.

        Args:
            container: Tag of the container.
            tag: Name of the node, unique in the container.
            pkg: Package, or ``NAME@VERSION`` for a version of a package that the user pushed.
            exe: A file in the package.
            args: Its command line, split into words as a shell does; ``$(find PKG)`` becomes a package's
                folder and ``$(env VAR)`` a variable.
            name: ROS name, if it differs from the node's own.
            namespace: ROS namespace, such as ``"/Robot1"``.
            restart: When it is restarted after it ended by itself: ``"never"``, ``"on-failure"`` or
                ``"always"``.
            max_restarts: Restarts in a row; 0 for no limit.
            after: Tags of nodes of the container that must be ready before it starts.
            heartbeat: A topic on which the node publishes while it works.
            heartbeat_timeout: Seconds of silence of that topic after which the node counts as stuck, 0.1 to
                86400.
            state_services: How its state is kept when the container moves or starts again: ``{"save":
                "~save_state", "restore": "~restore_state", "every": 10}``, two services of the node, and
                seconds from one snapshot to the next, 1 to 86400.

        Raises:
            ValueError: An argument is invalid; the text names it and the expected value.
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.add_node("brain", "map", "Test", "stringEcho.py", restart="on-failure")
            await robot.add_node("brain", "plan", "Test", "stringEcho.py", args="_rate:=5", after=["map"])
            ```
        """
        after = (after,) if isinstance(after, str) else after
        await self.request(ConfigureComponents(add_nodes=(_read(AddNode, locals()),)))

    async def remove_node(self, container: str, tag: str) -> None:
        """Stop a node. Cancelling does not withdraw the request.

        Args:
            container: Tag of the container.
            tag: The node.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.remove_node("brain", "map")
            ```
        """
        node = RemoveNode(container=container, tag=tag)
        await self.request(ConfigureComponents(remove_nodes=(node,)))

    async def set_parameter(self, container: str, name: str, value: Value) -> None:
        """Set a ROS parameter of a container. Cancelling does not withdraw the request.

        Args:
            container: Tag of the container.
            name: ROS name, such as ``"limits/speed"``.
            value: A number, a boolean, a text or a list of these; a text may contain ``$(find PKG)`` and
                ``$(env VAR)``.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.set_parameter("brain", "limits/speed", 0.5)
            ```
        """
        parameter = SetParameter(container=container, parameter=ParameterSpec(name=name, value=value))
        await self.request(ConfigureComponents(set_param=(parameter,)))

    async def delete_parameter(self, container: str, name: str) -> None:
        """Delete a ROS parameter of a container. Cancelling does not withdraw the request.

        Args:
            container: Tag of the container.
            name: ROS name, as given to :meth:`set_parameter`.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.delete_parameter("brain", "limits/speed")
            ```
        """
        parameter = DeleteParameter(container=container, name=name)
        await self.request(ConfigureComponents(delete_param=(parameter,)))

    # Interfaces and connections

    async def add_interface(
        self,
        endpoint: str,
        tag: str,
        interface_type: str,
        message_type: str,
        *,
        addr: str = "",
        queue_size: int = 0,
    ) -> None:
        """Create an interface of a container or a robot. Cancelling does not withdraw the request.

        For this robot's own interfaces use :meth:`rce_client.Connection.publisher`,
        :meth:`~rce_client.Connection.subscriber`, :meth:`~rce_client.Connection.service_client` and
        :meth:`~rce_client.Connection.service_provider`.

        Args:
            endpoint: Tag of the container or robot.
            tag: Name of the interface, unique at the endpoint.
            interface_type: The engine's role and form at this end: ``Publisher``, ``Subscriber``,
                ``ServiceClient`` or ``ServiceProvider``, then ``Interface`` (in a container), ``Converter``
                or ``Forwarder`` (at a robot), such as ``"PublisherInterface"``.
            message_type: Message or service type, ``package/Type``.
            addr: ROS name of the topic or service; containers need it.
            queue_size: How many messages of a topic may wait in each of the engine's queues; 1 is for
                commands of which only the newest counts. 0: as many as its limits allow.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            role = "PublisherInterface"
            await robot.add_interface("brain", "names", role, "std_msgs/String", addr="/names")
            ```
        """
        spec = InterfaceSpec(
            tag=tag, type=interface_type, message_type=message_type, addr=addr, queue_size=queue_size
        )
        interface = AddInterface(endpoint=endpoint, interface=spec)
        await self.request(ConfigureComponents(add_interfaces=(interface,)))

    async def remove_interface(self, endpoint: str, tag: str) -> None:
        """Remove an interface and its connections. Cancelling does not withdraw the request.

        Args:
            endpoint: Tag of the container or robot.
            tag: The interface.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.remove_interface("brain", "names")
            ```
        """
        interface = RemoveInterface(endpoint=endpoint, tag=tag)
        await self.request(ConfigureComponents(remove_interfaces=(interface,)))

    async def connect(self, a: str, b: str) -> None:
        """Connect two interfaces. Cancelling does not withdraw the request.

        Args:
            a: One interface, ``ENDPOINT/INTERFACE``.
            b: The other interface; the order does not matter.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.connect("testRobot/names", "brain/names")
            ```
        """
        await self.request(ConfigureConnections(connect=(Connection(tag_a=a, tag_b=b),)))

    async def disconnect(self, a: str, b: str) -> None:
        """Remove the connection of two interfaces. Cancelling does not withdraw the request.

        Args:
            a: One interface, ``ENDPOINT/INTERFACE``.
            b: The other interface; the order does not matter.

        Raises:
            RefusedError: The engine refused this client permanently.
            NotConnectedError: The program closed the connection, or has not opened it yet.

        Example:
            ```python
            await robot.disconnect("testRobot/names", "brain/names")
            ```
        """
        await self.request(ConfigureConnections(disconnect=(Connection(tag_a=a, tag_b=b),)))


def _read(request_type: type[R], arguments: dict[str, Any]) -> R:
    """Read a request from the arguments of a method, whose keywords are its fields.

    Raises:
        ValueError: An argument is invalid.
    """
    given = {
        name: list(value) if isinstance(value, Sequence) and not isinstance(value, str) else value
        for name, value in arguments.items()
        if name != "self"
    }
    return PLAIN.read(request_type, given)
