"""The messages between a client and its robot endpoint, as types.

Attribute names are snake_case; on the wire they are camelCase (``container_tag`` is ``containerTag``).
:mod:`rce.protocol.reading` makes them from JSON and checks them, :mod:`rce.protocol.codec` writes them.
Wire source: ``docs/protocol.md``.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from msgspec import Meta, Struct, field

from rce.model.names import (
    MAX_NAME_LENGTH,
    MAX_VERSION_LENGTH,
    MESSAGE_TYPE_PATTERN,
    NAME_PATTERN,
    VERSION_PATTERN,
    Form,
    Role,
)
from rce.protocol.limits import MAX_MESSAGE_ID_LENGTH

ROS_NAME_PATTERN = r"[~/]?[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*"
"""What a ROS topic, service, parameter or namespace may be called."""

_TYPE_PATTERN = f"({'|'.join(r.value for r in Role)})({'|'.join(f.value for f in Form)})"
# Grouped, so that it is another text than MESSAGE_TYPE_PATTERN and has words of its own in HUMAN_PATTERNS.
_INTERFACE_PATH_PATTERN = rf"({NAME_PATTERN})/({NAME_PATTERN})"
_EXECUTABLE_PATTERN = r"(?!/)(?!(.*/)?\.\.(/|\Z))[^\x00-\x1f\x7f]+"

Name = Annotated[str, Meta(pattern=rf"^{NAME_PATTERN}\Z", max_length=MAX_NAME_LENGTH)]
"""Names a user, robot, container, node or interface."""
PackageName = Annotated[
    str,
    Meta(
        pattern=rf"^{NAME_PATTERN}(@{VERSION_PATTERN})?\Z",
        max_length=MAX_NAME_LENGTH + 1 + MAX_VERSION_LENGTH,
    ),
]
"""A package, ``NAME``, or a version of one that a user brought, ``NAME@VERSION``."""
MessageTypeName = Annotated[str, Meta(pattern=rf"^{MESSAGE_TYPE_PATTERN}\Z", max_length=2 * MAX_NAME_LENGTH)]
"""A message or service class, ``package/Type``."""
TypeName = Annotated[str, Meta(pattern=rf"^{_TYPE_PATTERN}\Z")]
"""An interface type such as ``PublisherConverter``."""
RosName = Annotated[str, Meta(pattern=rf"^{ROS_NAME_PATTERN}\Z", max_length=255)]
"""A ROS name."""
OptionalRosName = Annotated[str, Meta(pattern=rf"^({ROS_NAME_PATTERN})?\Z", max_length=255)]
"""A ROS name or the empty string."""
OptionalName = Annotated[str, Meta(pattern=rf"^({NAME_PATTERN})?\Z", max_length=MAX_NAME_LENGTH)]
"""A name or the empty string."""
OptionalNamespace = Annotated[str, Meta(pattern=rf"^(/|{ROS_NAME_PATTERN}/?)?\Z", max_length=255)]
"""A ROS namespace or the empty string."""
Executable = Annotated[str, Meta(pattern=rf"^{_EXECUTABLE_PATTERN}\Z", max_length=255)]
"""A file below a package's folders; never absolute, never above the package."""
InterfacePath = Annotated[str, Meta(pattern=rf"^{_INTERFACE_PATH_PATTERN}\Z", max_length=2 * MAX_NAME_LENGTH)]
"""An interface of an endpoint, ``ENDPOINT/INTERFACE``."""
MessageId = Annotated[str, Meta(max_length=MAX_MESSAGE_ID_LENGTH)]
"""Echoed in the answer to a service request."""
MAX_SOURCE_LENGTH = 64
SourceName = Annotated[str, Meta(max_length=MAX_SOURCE_LENGTH)]
"""Names a publisher of latched messages within an interface."""
Text = Annotated[str, Meta(max_length=65536, pattern=r"^[^\x00]*\Z")]
"""Free text without a NUL, which no argument and no file name may hold."""
Quantity: TypeAlias = int | float | Text
"""An amount, as :mod:`rce.model.quantities` reads it."""
NetworkName: TypeAlias = Literal["", "none", "group", "host"]
"""What a container sees of the network; empty for the default."""
RestartName: TypeAlias = Literal["never", "on-failure", "always"]
"""When a node that ended is started again."""
Scalar: TypeAlias = bool | int | float | str
Value: TypeAlias = bool | int | float | str | list[Scalar]
"""A parameter's value."""

NO_ID = "nil"
"""The ``msgID`` of a message that expects no answer."""
UPDATE_TOPIC = "iu"
"""The ``topic`` of an interface's status."""

HUMAN_PATTERNS: dict[str, str] = {
    rf"^{NAME_PATTERN}\Z": "must be a name: letters, digits and '_', a letter first",
    rf"^({NAME_PATTERN})?\Z": "must be a name: letters, digits and '_', a letter first",
    rf"^{NAME_PATTERN}(@{VERSION_PATTERN})?\Z": (
        "must be a package's name (letters, digits and '_', a letter first), or NAME@VERSION such as"
        " nav@1.2.0"
    ),
    rf"^{MESSAGE_TYPE_PATTERN}\Z": "must be a class of the form package/Type",
    rf"^{_TYPE_PATTERN}\Z": (
        f"must be an interface type: one of {', '.join(r.value for r in Role)},"
        f" followed by one of {', '.join(f.value for f in Form)}"
    ),
    rf"^{ROS_NAME_PATTERN}\Z": "must be a ROS name such as /group/topic",
    rf"^({ROS_NAME_PATTERN})?\Z": "must be a ROS name such as /group/topic",
    rf"^(/|{ROS_NAME_PATTERN}/?)?\Z": "must be a ROS namespace such as /Robot1",
    rf"^{_EXECUTABLE_PATTERN}\Z": "must be the name of a file inside the package",
    rf"^{_INTERFACE_PATH_PATTERN}\Z": "must have the form ENDPOINT/INTERFACE",
    r"^[^\x00]*\Z": "must not hold a NUL character",
}
"""What to tell a client instead of a regular expression."""
CHOICES: dict[str, tuple[str, ...]] = {
    "network": ("none", "group", "host"),
    "restart": ("never", "on-failure", "always"),
}
"""The values that a key may have, by the key."""


class _Part(Struct, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """Base of everything that appears in a message; unknown keys are ignored."""


class ContainerData(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """What a container asks for; zero or empty: not requested."""

    group: Text = ""
    group_ip: Text = ""
    """IPv4, with or without ``/NN``."""
    network: NetworkName = ""
    image: Text = ""
    """Root file system: an OCI image's name, or a folder of the machine."""
    size: Annotated[int, Meta(ge=0, le=2**16)] = 1
    """Slots."""
    cpu: Quantity = 0.0
    """Cores, or a text such as ``"50%"``."""
    memory: Quantity = 0
    """MB, or a text such as ``"256M"``."""
    bandwidth: Quantity = 0
    """Bytes per second, or a text such as ``"10Mbit"``."""
    special_features: list[Text] | Text = []
    """Labels that the machine must have; a string is a list of its words."""
    wait: bool = False
    """Wait for a machine with room if there is none now; else that is an error."""

    @property
    def features(self) -> tuple[str, ...]:
        """The special features as a tuple, whichever way they were written."""
        given = self.special_features
        return tuple(given.split()) if isinstance(given, str) else tuple(given)

    @property
    def joins_group(self) -> bool:
        """Whether it is to be in the network of its group: that is said, or an address there is given."""
        return self.network == "group" or (not self.network and bool(self.group_ip))


class ResizeData(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """A change of a container's resources; None leaves a value as it is, zero withdraws the request."""

    size: Annotated[int, Meta(ge=1, le=2**16)] | None = None
    cpu: Quantity | None = None
    memory: Quantity | None = None
    bandwidth: Quantity | None = None


class CreateContainer(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """``CC``: make a container."""

    container_tag: Name
    container_data: ContainerData = ContainerData()


class ResizeContainer(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """``RC``: change what a container may use, while it runs."""

    container_tag: Name
    container_data: ResizeData


class DestroyContainer(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """``DC``: remove a container and all that is in it."""

    container_tag: Name


class AddNode(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """Start a node in a container."""

    container_tag: Name
    node_tag: Name
    pkg: PackageName
    exe: Executable
    args: Text = ""
    name: OptionalName = ""
    namespace: OptionalNamespace = ""
    restart: RestartName = "never"
    max_restarts: Annotated[int, Meta(ge=0, le=2**31 - 1)] = 5
    """In a row; 0 for no limit."""
    after: tuple[Name, ...] = ()
    """Tags of nodes of the same container that must be ready before this one starts."""
    heartbeat: OptionalRosName = ""
    """A topic that the node publishes as long as it is well."""
    heartbeat_timeout: Annotated[float, Meta(ge=0.1, le=86400.0)] = 5.0
    """Seconds."""


class RemoveNode(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """Stop a node."""

    container_tag: Name
    node_tag: Name


class AddInterface(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """Make an interface of a container or a robot."""

    endpoint_tag: Name
    interface_tag: Name
    interface_type: TypeName
    message_type: MessageTypeName = field(name="className")
    addr: OptionalRosName = ""
    """ROS name of the topic or service; container ends need it."""


class RemoveInterface(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """Remove an interface and its connections."""

    endpoint_tag: Name
    interface_tag: Name


class SetParam(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """Set a parameter of a container."""

    container_tag: Name
    name: RosName
    value: Value


class DeleteParam(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """Delete a parameter of a container."""

    container_tag: Name
    name: RosName


class Connection(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """Two interfaces that are (to be) joined."""

    tag_a: InterfacePath
    tag_b: InterfacePath


class ConfigureComponents(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """``CN``: add and remove nodes, interfaces and parameters. Removals are meant to be done first."""

    add_nodes: tuple[AddNode, ...] = ()
    remove_nodes: tuple[RemoveNode, ...] = ()
    add_interfaces: tuple[AddInterface, ...] = ()
    remove_interfaces: tuple[RemoveInterface, ...] = ()
    set_param: tuple[SetParam, ...] = ()
    delete_param: tuple[DeleteParam, ...] = ()
    faults: tuple[str, ...] = ()
    """One text for each item that was refused in reading; not on the wire."""


class ConfigureConnections(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """``CX``: join and part interfaces."""

    connect: tuple[Connection, ...] = ()
    disconnect: tuple[Connection, ...] = ()
    faults: tuple[str, ...] = ()
    """One text for each item that was refused in reading; not on the wire."""


class DataMessage(Struct, frozen=True, omit_defaults=False):
    """``DM``: a message on a topic, a service request or its answer, at one interface."""

    i_tag: Name = field(name="iTag")
    message_type: MessageTypeName = field(name="type")
    msg: Any
    """A JSON object, or bytes where the message travels serialized."""
    msg_id: MessageId = field(name="msgID", default=NO_ID)
    latch: SourceName = ""
    """The source whose latched message it is; empty if it is not latched."""


class LatchedSources(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """``LT``: the sources whose latched messages are in force at an interface; all others ended."""

    i_tag: Name
    sources: tuple[SourceName, ...] = ()


class InterfaceStatus(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """``ST``: an interface became usable (``True``) or unusable."""

    i_tag: Name
    status: bool
    topic: str = field(default_factory=lambda: UPDATE_TOPIC)


class ErrorReport(_Part, frozen=True, kw_only=True, omit_defaults=True, rename="camel"):
    """``ER``: something that the client asked for failed."""

    text: str


Request: TypeAlias = (
    CreateContainer | ResizeContainer | DestroyContainer | ConfigureComponents | ConfigureConnections
)
"""What a client may ask of the master."""
ClientMessage: TypeAlias = Request | DataMessage | LatchedSources | InterfaceStatus | ErrorReport
"""Any message of the protocol."""

REQUEST_TYPES: dict[str, type[Request]] = {
    "CC": CreateContainer,
    "DC": DestroyContainer,
    "CN": ConfigureComponents,
    "CX": ConfigureConnections,
    "RC": ResizeContainer,
}
TYPES: dict[str, type[ClientMessage]] = {
    **REQUEST_TYPES,
    "DM": DataMessage,
    "LT": LatchedSources,
    "ST": InterfaceStatus,
    "ER": ErrorReport,
}
"""The value of ``type`` to the class of the message."""
UPWARD = frozenset(("CC", "DC", "CN", "CX", "RC", "DM", "LT"))
"""Types that a client sends."""
DOWNWARD = frozenset(("DM", "LT", "ST", "ER"))
"""Types that the engine sends."""

_TAGS = {cls: tag for tag, cls in TYPES.items()}


def type_of(message: ClientMessage) -> str:
    """Return the value of ``type`` for a message, such as ``CN``."""
    return _TAGS[type(message)]
