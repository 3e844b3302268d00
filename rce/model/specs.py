"""What users ask for: containers, nodes, parameters and interfaces.

These are the forms that the engine keeps and that cross the control channel: amounts are numbers, names are
checked.
"""

from __future__ import annotations

from enum import Enum

from msgspec import Struct, field

ParameterValue = bool | int | float | str | list[bool | int | float | str]
"""A parameter's value on the wire."""


class InterfaceSpec(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An interface of an endpoint."""

    tag: str
    type: str
    """An interface type such as ``PublisherInterface`` (see :class:`rce.model.names.InterfaceType`)."""
    message_type: str = field(name="cls")
    """Message or service class, ``package/Type``."""
    addr: str = ""
    """ROS name of the topic or service; container ends only."""


class RestartPolicy(Enum):
    """When a node that ended by itself is started again."""

    NEVER = "never"
    ON_FAILURE = "on-failure"
    """After any end but exit code 0."""
    ALWAYS = "always"


class NodeSpec(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A node of a container."""

    tag: str
    pkg: str
    exe: str
    args: str = ""
    """Split as a POSIX shell splits, never given to one. May hold ``$(find PKG)`` and ``$(env VAR)``."""
    name: str = ""
    namespace: str = ""
    restart: RestartPolicy = RestartPolicy.NEVER
    max_restarts: int = 5
    """How often in a row it is started again; one that ran well for a while counts anew. 0: no limit."""
    after: tuple[str, ...] = ()
    """Tags of nodes that must be ready before this one starts."""
    heartbeat: str = ""
    """A topic that the node publishes as long as it is well; empty for none."""
    heartbeat_timeout: float = 5.0
    """Seconds without a message on the heartbeat topic after which the node is taken for stuck."""


class ParameterSpec(Struct, frozen=True, kw_only=True):
    """A parameter of a container's ROS parameter server."""

    name: str
    value: ParameterValue


class Network(Enum):
    """What a container sees of the network, beside its own loopback and its links."""

    NONE = "none"
    GROUP = "group"
    """The containers of the same user and group, on the same machine, at their ``group_ip``."""
    HOST = "host"
    """The machine's own network; for containers of administrators only."""


class Resources(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a container asks for. Zero or empty: not requested."""

    group: str = ""
    group_ip: str = ""
    network: Network = Network.NONE
    image: str = ""
    """Root file system: an OCI image's name, or a folder of the machine; needs the runtime ``podman``."""
    size: int = 1
    """Slots of the machine that it takes; the limits it does not set itself are so many times a slot's."""
    cpu: float = 0.0
    """Cores."""
    memory: int = 0
    """Bytes."""
    bandwidth: int = 0
    """Bytes per second on the container's links."""
    special_features: tuple[str, ...] = ()
