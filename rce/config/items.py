"""The items that a robot's file lists: containers, nodes, parameters, interfaces and connections.

Keys are those of the RoboEarth Cloud Engine's files (``docs/protocol.md``).
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from rce.config.validation import Strict
from rce.model.names import InterfaceType
from rce.model.quantities import read_bandwidth, read_cores, read_memory
from rce.protocol import messages
from rce.protocol.messages import CHOICES, HUMAN_PATTERNS, AddNode, ContainerData

if TYPE_CHECKING:
    from collections.abc import Callable


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
MessageTypeName = Annotated[str, _matches(messages.MessageTypeName)]
InterfacePath = Annotated[str, _matches(messages.InterfacePath)]


class Container(Strict):
    """A container to make; zero or empty: not requested."""

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
    """When it is started again after it ended."""
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
    message_type: MessageTypeName = Field(alias="iCls")
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
