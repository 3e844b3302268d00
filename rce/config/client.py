"""The config file of ``rce-ros``: which robot this is, and what it wants in the cloud.

Keys are those of the RoboEarth Cloud Engine's files (``docs/protocol.md``).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlsplit

from pydantic import AfterValidator, BeforeValidator, Field, SecretStr, ValidationError

from rce.config import client_checks
from rce.config.documents import parse, read_file
from rce.config.exceptions import ConfigError, Fault
from rce.config.validation import Strict, faults_of
from rce.protocol import messages
from rce.protocol.messages import (
    CHOICES,
    HUMAN_PATTERNS,
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
    Request,
    SetParam,
)
from rce.protocol.names import InterfaceType
from rce.protocol.quantities import read_bandwidth, read_cores, read_memory

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.tls.identity import Context


def _matches(kind: Any) -> AfterValidator:
    """Check with the rule that the protocol has for the same value."""
    (meta,) = kind.__metadata__
    pattern = re.compile(meta.pattern)

    def check(text: str) -> str:
        if not pattern.match(text):
            raise ValueError(HUMAN_PATTERNS[meta.pattern])
        if meta.max_length is not None and len(text) > meta.max_length:
            raise ValueError(f"must have at most {meta.max_length} characters")
        return text

    return AfterValidator(check)


def _check_url(url: str) -> str:
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        valid = False
    if not valid:
        raise ValueError("must be the master's address such as http://master:9000/")
    return url


def _check_authority(text: str) -> str:
    if text and not Path(text).expanduser().is_file():
        raise ValueError(f"there is no file {text}; copy authority.pem from the engine's certificates folder")
    return text


def _check_type(text: str) -> str:
    InterfaceType.parse(text)
    return text


def _check_value(value: Any) -> Any:
    for item in value if isinstance(value, list) else [value]:
        if not isinstance(item, bool | int | float | str):
            raise ValueError("must be a number, a boolean, a string, or a list of such")  # noqa: TRY004 - pydantic's
    return value


def _check_features(value: Any) -> Any:
    if not all(isinstance(item, str) for item in (value if isinstance(value, list) else [value])):
        raise ValueError("must be a string or a list of strings")
    return value


def _quantity(read: Callable[[object], float]) -> AfterValidator:
    """Check an amount with the reader that the protocol has for it; it stays as it was written."""

    def check(value: Any) -> Any:
        read(value)
        return value

    return AfterValidator(check)


def _one_of(key: str) -> BeforeValidator:
    def check(value: Any) -> Any:
        if value not in CHOICES[key]:
            raise ValueError(f"must be one of {', '.join(CHOICES[key])}")
        return value

    return BeforeValidator(check)


Name = Annotated[str, _matches(messages.Name)]
PackageName = Annotated[str, _matches(messages.PackageName)]
Text = Annotated[str, _matches(messages.Text)]
RosName = Annotated[str, _matches(messages.RosName)]
ClassName = Annotated[str, _matches(messages.ClassName)]
InterfacePath = Annotated[str, _matches(messages.InterfacePath)]


class Container(Strict):
    """A container to make; zero or empty means no wish."""

    tag: Name = Field(alias="cTag")
    group: Text = ""
    group_ip: Text = Field(default="", alias="groupIp")
    network: Annotated[Any, _one_of("network")] = ""
    image: Text = ""
    size: int = Field(default=1, ge=0, le=2**16)
    """Slots of the machine."""
    cpu: Annotated[Any, _quantity(read_cores)] = 0
    """Cores, or a text such as ``50%``."""
    memory: Annotated[Any, _quantity(read_memory)] = 0
    """MB, or a text such as ``256M``."""
    bandwidth: Annotated[Any, _quantity(read_bandwidth)] = 0
    """Bytes per second, or a text such as ``10Mbit``."""
    wait: bool = False
    """Wait for room if no machine has any."""
    special_features: Annotated[Any, AfterValidator(_check_features)] = Field(
        default="", alias="specialFeatures"
    )
    """Labels that the machine must have: a list of strings, or one string of words."""

    def data(self) -> ContainerData:
        """The same as the protocol has it."""
        return ContainerData(
            group=self.group,
            group_ip=self.group_ip,
            network=self.network,
            image=self.image,
            size=self.size,
            cpu=self.cpu,
            memory=self.memory,
            bandwidth=self.bandwidth,
            special_features=self.special_features,
            wait=self.wait,
        )


class Node(Strict):
    """A node to start in a container."""

    container: Name = Field(alias="cTag")
    tag: Name = Field(alias="nTag")
    pkg: PackageName
    exe: Annotated[str, _matches(messages.Executable)]
    args: Text = ""
    name: Annotated[str, _matches(messages.OptionalName)] = ""
    namespace: Annotated[str, _matches(messages.OptionalNamespace)] = ""
    restart: Annotated[Any, _one_of("restart")] = "never"
    """When it is started again after it ended by itself."""
    max_restarts: int = Field(default=5, alias="maxRestarts", ge=0, lt=2**31)
    """In a row; 0 for no limit."""
    after: tuple[Name, ...] = Field(default=(), strict=False)
    """Tags of nodes that must be ready before it starts."""
    heartbeat: Annotated[str, _matches(messages.OptionalRosName)] = ""
    """A topic that it publishes as long as it is well."""
    heartbeat_timeout: float = Field(default=5.0, alias="heartbeatTimeout", ge=0.1, le=86400)
    """Seconds."""

    def message(self) -> AddNode:
        """The same as the protocol has it."""
        return AddNode(
            container_tag=self.container,
            node_tag=self.tag,
            pkg=self.pkg,
            exe=self.exe,
            args=self.args,
            name=self.name,
            namespace=self.namespace,
            restart=self.restart,
            max_restarts=self.max_restarts,
            after=self.after,
            heartbeat=self.heartbeat,
            heartbeat_timeout=self.heartbeat_timeout,
        )


class Parameter(Strict):
    """A parameter to set in a container."""

    container: Name = Field(alias="cTag")
    name: RosName
    value: Annotated[Any, AfterValidator(_check_value)]
    """Integer, number, boolean, string, or a list of such."""


class Interface(Strict):
    """An interface to make."""

    endpoint: Name = Field(alias="eTag")
    tag: Name = Field(alias="iTag")
    type: Annotated[str, AfterValidator(_check_type)] = Field(alias="iType")
    cls: ClassName = Field(alias="iCls")
    addr: Annotated[str, _matches(messages.OptionalRosName)] = ""
    """ROS name of the topic or service: in the container, or (Forwarders) in the robot's own graph."""

    @property
    def path(self) -> str:
        """``ENDPOINT/INTERFACE``."""
        return f"{self.endpoint}/{self.tag}"

    @property
    def kind(self) -> InterfaceType:
        """The parsed type."""
        return InterfaceType.parse(self.type)


class Link(Strict):
    """Two interfaces to join."""

    a: InterfacePath = Field(alias="tagA")
    b: InterfacePath = Field(alias="tagB")


class ClientConfig(Strict):
    """All that one robot's file says."""

    url: Annotated[str, AfterValidator(_check_url)]
    """The master's address."""
    user: Name = Field(alias="userID")
    password: SecretStr = SecretStr("")
    """The user's password; empty if there is a token."""
    token: SecretStr = SecretStr("")
    """The robot's own token, as ``rce robot add`` gives it."""
    robot: Name = Field(alias="robotID")
    authority: Annotated[str, AfterValidator(_check_authority)] = ""
    """File with the authority that issued the engine's certificate; the system's authorities if empty."""
    containers: tuple[Container, ...] = Field(default=(), strict=False)
    nodes: tuple[Node, ...] = Field(default=(), strict=False)
    parameters: tuple[Parameter, ...] = Field(default=(), strict=False)
    interfaces: tuple[Interface, ...] = Field(default=(), strict=False)
    connections: tuple[Link, ...] = Field(default=(), strict=False)

    @property
    def robot_interfaces(self) -> tuple[Interface, ...]:
        """The interfaces of the robot itself."""
        return tuple(item for item in self.interfaces if item.endpoint == self.robot)

    @property
    def authority_file(self) -> Path | None:
        """The certificate of the authority to trust; None for the system's authorities."""
        return Path(self.authority).expanduser() if self.authority else None

    def setup(self) -> list[Request]:
        """Return the requests that make everything, in the order in which they must be sent."""
        requests: list[Request] = [
            CreateContainer(container_tag=item.tag, container_data=item.data()) for item in self.containers
        ]
        if self.nodes or self.parameters or self.interfaces:
            requests.append(self._components())
        if self.connections:
            requests.append(ConfigureConnections(connect=self._links()))
        return requests

    def teardown(self) -> list[Request]:
        """Return the requests that remove everything again, in order."""
        requests: list[Request] = []
        if self.connections:
            requests.append(ConfigureConnections(disconnect=self._links()))
        if self.nodes or self.parameters or self.interfaces:
            requests.append(
                ConfigureComponents(
                    remove_interfaces=tuple(
                        RemoveInterface(endpoint_tag=item.endpoint, interface_tag=item.tag)
                        for item in self.interfaces
                    ),
                    remove_nodes=tuple(
                        RemoveNode(container_tag=item.container, node_tag=item.tag) for item in self.nodes
                    ),
                    delete_param=tuple(
                        DeleteParam(container_tag=item.container, name=item.name) for item in self.parameters
                    ),
                )
            )
        requests += [DestroyContainer(container_tag=item.tag) for item in self.containers]
        return requests

    def _components(self) -> ConfigureComponents:
        return ConfigureComponents(
            set_param=tuple(
                SetParam(container_tag=item.container, name=item.name, value=item.value)
                for item in self.parameters
            ),
            add_nodes=tuple(item.message() for item in self.nodes),
            add_interfaces=tuple(
                AddInterface(
                    endpoint_tag=item.endpoint,
                    interface_tag=item.tag,
                    interface_type=item.type,
                    class_name=item.cls,
                    addr=item.addr,
                )
                for item in self.interfaces
            ),
        )

    def _links(self) -> tuple[Connection, ...]:
        return tuple(Connection(tag_a=item.a, tag_b=item.b) for item in self.connections)


def load(path: Path) -> ClientConfig:
    """Read a config file, JSON or YAML.

    Raises:
        ConfigError: It cannot be read, or something is wrong in it; every fault is listed.
    """
    return loads(read_file(path), str(path))


def loads(text: str, source: str = "config") -> ClientConfig:
    """Read a config from text.

    Args:
        text: JSON or YAML.
        source: Name of the file, for errors.

    Raises:
        ConfigError: Something is wrong in it; every fault is listed.
    """
    data = parse(text, source)
    if not isinstance(data, dict):
        raise ConfigError(
            source, [Fault("", "must be an object with the keys url, userID, password, robotID")]
        )
    try:
        config, faults = ClientConfig.model_validate(data), []
    except ValidationError as error:
        config, faults = None, faults_of(error, ClientConfig)
    faults += client_checks.credential_faults(data)
    faults += client_checks.check(client_checks.Parts.salvage(data, _ITEMS))
    if faults or config is None:
        raise ConfigError(source, faults)
    return config


_ITEMS: dict[str, type[Strict]] = {
    "containers": Container,
    "nodes": Node,
    "parameters": Parameter,
    "interfaces": Interface,
    "connections": Link,
}
