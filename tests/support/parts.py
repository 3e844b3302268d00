"""Keywords of the engine's structs that helpers of tests pass on."""

from __future__ import annotations

from typing import TypedDict

from rce.control.model import (
    ConnectionSpec,
    LinkAddress,
    LinkSpec,
    NodeStatus,
    PackageSpec,
    VolumePlacement,
)
from rce.model import StateServices, Volume
from rce.model.specs import InterfaceSpec, Network, NodeSpec, ParameterSpec, Resources, RestartPolicy


class SpecParts(TypedDict, total=False):
    """What a container's spec says beside its name."""

    nodes: tuple[NodeSpec, ...]
    interfaces: tuple[InterfaceSpec, ...]
    links: tuple[LinkSpec, ...]
    connections: tuple[ConnectionSpec, ...]
    resources: Resources
    parameters: tuple[ParameterSpec, ...]
    packages: tuple[PackageSpec, ...]
    volumes: tuple[VolumePlacement, ...]


class NodeLife(TypedDict, total=False):
    """How a node lives: fields of :class:`rce.model.specs.NodeSpec`."""

    after: tuple[str, ...]
    heartbeat: str
    heartbeat_timeout: float
    restart: RestartPolicy
    max_restarts: int
    state_services: StateServices | None


class MachineParts(TypedDict, total=False):
    """Fields of :class:`rce.control.messages.MachineInfo` beside its name."""

    slots: int
    cores: int
    memory: int
    labels: tuple[str, ...]
    runtimes: tuple[str, ...]
    networks: tuple[str, ...]
    volumes: str


class ResourceParts(TypedDict, total=False):
    """Fields of :class:`rce.model.specs.Resources`."""

    group: str
    group_ip: str
    network: Network
    image: str
    size: int
    cpu: float
    memory: int
    bandwidth: int
    special_features: tuple[str, ...]
    volumes: tuple[Volume, ...]


class StatusParts(TypedDict, total=False):
    """Fields of :class:`rce.control.model.EndpointStatus` that tests give."""

    incarnation: str
    address: LinkAddress
    nodes: tuple[NodeStatus, ...]
    connections: tuple[int, ...]
    detail: str
