"""The plan of a bridge, from a robot's config. Pure, apart from looking up message types.

An interface of the robot with an ``addr`` ends in the robot's ROS graph. It is made as a Forwarder, whatever
the file says: messages are serialized at both ends, so nothing is gained by taking them apart on the way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec

from rce.config import ConfigError, Fault
from rce.model import ConfigureComponents, Form, InterfaceType, Request, Role
from rce.ros.types import TypeRegistry, TypesError

if TYPE_CHECKING:
    from rce.config.client import ClientConfig


@dataclass(frozen=True, slots=True)
class Span:
    """One interface that ends in the robot's graph."""

    tag: str
    role: Role
    """The engine's name for it: a robot's sensor is a ``SUBSCRIBER``."""
    message_type: str
    addr: str
    """Topic or service in the robot's graph."""
    on_demand: bool = False
    """Subscribe to the topic only while the interface is connected: no connection of the file names it."""
    queue_size: int = 0
    """Messages that may wait for the network; 0: as many as the limits allow."""

    @property
    def type(self) -> str:
        """The interface type to request."""
        return str(InterfaceType(self.role, Form.FORWARDER))

    def __str__(self) -> str:
        return f"{self.tag}: {_WORDS[self.role].format(self.addr)}, {self.message_type}"


_WORDS = {
    Role.SUBSCRIBER: "topic {} to the cloud",
    Role.PUBLISHER: "topic {} from the cloud",
    Role.SERVICE_PROVIDER: "service {}, answered in the cloud",
    Role.SERVICE_CLIENT: "service {}, called from the cloud",
}


@dataclass(frozen=True, slots=True)
class Plan:
    """All that ``rce-ros`` does for one robot."""

    robot: str
    spans: tuple[Span, ...]
    requests: tuple[Request, ...]
    """Other requests to the engine, in order; those of :attr:`first` before the spans are created."""
    first: int
    awaited: frozenset[str]
    """Tags of spans that the file connects, so that they become active."""
    unbridged: tuple[str, ...]
    """Tags of the robot's interfaces without ``addr``, which are not connected to the ROS graph."""


def make_plan(config: ClientConfig) -> Plan:
    """Return what is to be done for a robot's config."""
    ends = {end for link in config.connections for end in (link.tag_a, link.tag_b)}
    spans = tuple(
        Span(
            own.tag,
            own.kind.role,
            own.message_type,
            own.addr,
            on_demand=own.kind.role is Role.SUBSCRIBER and f"{config.robot}/{own.tag}" not in ends,
            queue_size=own.queue_size,
        )
        for own in config.robot_interfaces
        if own.addr
    )
    bridged = {span.tag for span in spans}
    requests = [_without(request, config.robot, bridged) for request in config.setup()]
    first = sum(1 for _ in config.containers)
    return Plan(
        robot=config.robot,
        spans=spans,
        requests=tuple(requests),
        first=first,
        awaited=frozenset(tag for tag in bridged if f"{config.robot}/{tag}" in ends),
        unbridged=tuple(own.tag for own in config.robot_interfaces if not own.addr),
    )


def check(config: ClientConfig, types: TypeRegistry, source: str) -> None:
    """Check what only matters to a bridge.

    Raises:
        ConfigError: A message type is not known here, or a service would call itself; every fault is listed.
    """
    faults = []
    services: dict[str, Role] = {}
    for index, item in enumerate(config.interfaces):
        own = item.interface
        if item.endpoint != config.robot or not own.addr:
            continue
        place = f"interfaces[{index}]"
        try:
            if own.kind.role.is_service:
                types.service(own.message_type)
            else:
                types.message(own.message_type)
        except TypesError as error:
            faults.append(Fault(f"{place}.iCls", str(error)))
        role = own.kind.role
        if role.is_service and services.setdefault(own.addr.lstrip("/"), role) is role.complement:
            faults.append(
                Fault(
                    f"{place}.addr",
                    f"service {own.addr} is answered in the cloud and called from it: a loop",
                )
            )
    if faults:
        raise ConfigError(source, faults)


def _without(request: Request, endpoint: str, tags: set[str]) -> Request:
    """Leave out the interfaces that the bridge makes itself."""
    if not isinstance(request, ConfigureComponents):
        return request
    kept = tuple(
        item for item in request.add_interfaces if item.endpoint != endpoint or item.interface.tag not in tags
    )
    return msgspec.structs.replace(request, add_interfaces=kept)
