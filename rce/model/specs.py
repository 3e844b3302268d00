"""Specs of containers, nodes, parameters and interfaces.

This is the only definition of their fields. A field's annotation has the type that the engine keeps, stores
and sends over the control channel, and by :class:`rce.model.written.AsWritten` the form in which users write
it: in messages of the client protocol, in config files and in bodies of the REST API
(:mod:`rce.model.spelling`).
"""

from __future__ import annotations

from enum import Enum
from typing import Annotated

from msgspec import Meta, Struct, field

from rce.model import written
from rce.model.checks import read_group_address, read_image, read_parameter_value
from rce.model.names import InterfaceType
from rce.model.quantities import (
    read_bandwidth,
    read_cores,
    read_memory,
    write_plain_memory,
)
from rce.model.state_services import (
    StateServices,
    WrittenStateServices,
    read_state_services,
    write_state_services,
)
from rce.model.volumes import Volume, WrittenVolume, read_volumes, write_volumes
from rce.model.written import AsWritten

ParameterValue = bool | int | float | str | list[bool | int | float | str]
"""A parameter's value on the wire."""


class Network(Enum):
    """A container's access to the network, beside its own loopback and its links."""

    NONE = "none"
    GROUP = "group"
    """The containers of the same user and group, on the same machine, at their ``group_ip``."""
    HOST = "host"
    """The machine's own network; for containers of administrators only."""


class RestartPolicy(Enum):
    """When a node that ended is started again."""

    NEVER = "never"
    ON_FAILURE = "on-failure"
    """After any end except with exit code 0."""
    ALWAYS = "always"


def _read_features(value: list[str] | str) -> tuple[str, ...]:
    # Checked here: msgspec 0.22 corrupts memory when it frees a union of a list and a text with a pattern.
    features = tuple(value.split() if isinstance(value, str) else value)
    if any("\0" in feature for feature in features):
        raise ValueError("must not hold a NUL character")
    if sum(map(len, features)) > _MAX_FEATURES:
        raise ValueError(f"must have at most {_MAX_FEATURES} characters")
    return features


def _value_of(member: Enum) -> str:
    return str(member.value)


_MAX_SLOTS = 2**16
_MAX_FEATURES = 65536
_TEXT = AsWritten(written.Text)
_NAME = AsWritten(written.Name)
_ROS_NAME = AsWritten(written.OptionalRosName)
_CORES = AsWritten(written.Quantity, read_cores)
_MEMORY = AsWritten(written.Quantity, read_memory, write_plain_memory)
_RATE = AsWritten(written.Quantity, read_bandwidth)
_SLOTS = AsWritten(Annotated[int, Meta(ge=0, le=_MAX_SLOTS)], lambda slots: max(1, slots))
_GIVEN_SLOTS = AsWritten(Annotated[int, Meta(ge=1, le=_MAX_SLOTS)])
_LABELS = AsWritten(list[str] | str, _read_features, list, words="must be a string or a list of strings")
_NETWORK = AsWritten(written.NetworkName, Network, _value_of, blank="")
_RESTART = AsWritten(written.RestartName, RestartPolicy, _value_of)
_VOLUMES = AsWritten(list[WrittenVolume], read_volumes, write_volumes)
_STATE = AsWritten(WrittenStateServices, read_state_services, write_state_services)
_TAGS = AsWritten(tuple[written.Name, ...])
_TIMES = AsWritten(Annotated[int, Meta(ge=0, le=2**31 - 1)])
_TIMEOUT = AsWritten(Annotated[float, Meta(ge=0.1, le=86400.0)])


class Resources(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The resources that a container requests. Zero or empty means: not requested."""

    size: Annotated[int, _SLOTS] = 1
    """Slots of the machine that it takes; the limits it does not set itself are so many times a slot's."""
    cpu: Annotated[float, _CORES] = 0.0
    """Cores."""
    memory: Annotated[int, _MEMORY] = 0
    """Bytes."""
    bandwidth: Annotated[int, _RATE] = 0
    """Bytes per second on the container's links."""
    special_features: Annotated[tuple[str, ...], _LABELS] = ()
    """Labels that the machine must have."""
    network: Annotated[Network, _NETWORK] = Network.NONE
    group: Annotated[str, _TEXT] = ""
    group_ip: Annotated[str, AsWritten(written.Text, read_group_address)] = ""
    """IPv4, with or without ``/NN``."""
    image: Annotated[str, AsWritten(written.Text, read_image)] = ""
    """Root file system: an OCI image's name, or a folder of the machine; needs the runtime ``podman``."""
    volumes: Annotated[tuple[Volume, ...], _VOLUMES] = ()
    """Folders of the user's on its machine that outlive it."""


class ResourceChanges(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Changes of a container's resources. None leaves one as it is, zero withdraws it."""

    size: Annotated[int | None, _GIVEN_SLOTS] = None
    cpu: Annotated[float | None, _CORES] = None
    memory: Annotated[int | None, _MEMORY] = None
    bandwidth: Annotated[int | None, _RATE] = None

    def given(self) -> dict[str, float]:
        """The new values, by field."""
        values = {name: getattr(self, name) for name in self.__struct_fields__}
        return {name: value for name, value in values.items() if value is not None}


class NodeSpec(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A node of a container."""

    tag: Annotated[str, _NAME]
    pkg: Annotated[str, AsWritten(written.PackageName)]
    exe: Annotated[str, AsWritten(written.Executable)]
    args: Annotated[str, _TEXT] = ""
    """Split as a POSIX shell splits, never given to one. May hold ``$(find PKG)`` and ``$(env VAR)``."""
    name: Annotated[str, AsWritten(written.OptionalName)] = ""
    namespace: Annotated[str, AsWritten(written.OptionalNamespace)] = ""
    restart: Annotated[RestartPolicy, _RESTART] = RestartPolicy.NEVER
    """When it is started again after it ended."""
    max_restarts: Annotated[int, _TIMES] = 5
    """How often in a row it is started again; the count restarts after it ran well. 0: no limit."""
    after: Annotated[tuple[str, ...], _TAGS] = ()
    """Tags of nodes that must be ready before this one starts."""
    heartbeat: Annotated[str, _ROS_NAME] = ""
    """A topic that the node publishes as long as it works; empty for none."""
    heartbeat_timeout: Annotated[float, _TIMEOUT] = 5.0
    """Seconds without a message on the heartbeat topic after which the node counts as stuck."""
    state_services: Annotated[StateServices | None, _STATE] = field(default=None, name="state")
    """How its state is kept when its container moves or starts again; None: it is lost."""


class ParameterSpec(Struct, frozen=True, kw_only=True):
    """A parameter of a container's ROS parameter server."""

    name: Annotated[str, AsWritten(written.RosName)]
    value: Annotated[
        ParameterValue,
        AsWritten(
            written.Value,
            read_parameter_value,
            words="must be a number, a boolean, a string, or a list of such",
        ),
    ]


class InterfaceSpec(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An interface of an endpoint."""

    tag: Annotated[str, _NAME]
    type: Annotated[str, AsWritten(written.InterfaceTypeName)]
    """An interface type such as ``PublisherInterface`` (see :class:`rce.model.names.InterfaceType`)."""
    message_type: Annotated[str, AsWritten(written.MessageTypeName)] = field(name="cls")
    """Message or service type, ``package/Type``."""
    addr: Annotated[str, _ROS_NAME] = ""
    """ROS name of the topic or service: in the container, or (Forwarders) in the robot's own graph."""
    queue_size: Annotated[int, _TIMES] = 0
    """Messages of a topic that may wait in each of the engine's queues; 0: as many as its limits allow."""

    @property
    def kind(self) -> InterfaceType:
        """The interface type, in its parts.

        Raises:
            ValueError: The type does not exist; the text lists the valid ones.
        """
        return InterfaceType.parse(self.type)
