"""The channels of an endpoint's interfaces, their changes, and the parts that could not be made."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rce.control import ConnectionSpec, DesiredState
    from rce.link.channel import Channel
    from rce.model import InterfaceSpec


@dataclass(slots=True)
class WiringNews:
    """Changes of an endpoint's interfaces and connections over a period."""

    changed_interfaces: dict[str, None] = field(default_factory=dict)
    changed_connections: dict[int, None] = field(default_factory=dict)
    interfaces: dict[str, bool] = field(default_factory=dict)
    """Tag to whether it has an established connection, of those that are new or changed."""
    removed_interfaces: list[str] = field(default_factory=list)
    connections: list[int] = field(default_factory=list)
    """Established."""
    lost_connections: list[int] = field(default_factory=list)
    """Lost, or removed."""

    def __bool__(self) -> bool:
        return bool(self.changed_interfaces or self.changed_connections)


class ChannelTable:
    """The channels of an endpoint by number and interface: both ends of a connection may be here."""

    def __init__(self) -> None:
        self._channels: dict[int, dict[str, Channel]] = {}

    def __iter__(self) -> Iterator[Channel]:
        return (channel for ends in self._channels.values() for channel in ends.values())

    def add(self, channel: Channel) -> None:
        """Add a channel."""
        self._channels.setdefault(channel.number, {})[channel.spec.interface] = channel

    def remove(self, channel: Channel) -> None:
        """Remove a channel."""
        ends = self._channels[channel.number]
        del ends[channel.spec.interface]
        if not ends:
            del self._channels[channel.number]

    def replace(self, channel: Channel) -> None:
        """Put a channel in the place of another one of the same connection."""
        self._channels[channel.number][channel.spec.interface] = channel

    def has(self, end: ConnectionSpec) -> bool:
        """Return whether there is a channel for an end of a connection."""
        return end.interface in self._channels.get(end.id, {})

    def of(self, number: int) -> tuple[Channel, ...]:
        """Return the channels of a connection."""
        return tuple(self._channels.get(number, {}).values())

    def is_established(self, number: int) -> bool:
        """Return whether a connection is established, at all its ends that are here."""
        channels = self._channels.get(number, {})
        return bool(channels) and all(channel.established for channel in channels.values())

    @property
    def established(self) -> tuple[int, ...]:
        """Ids of the established connections, in order."""
        return tuple(sorted(number for number in self._channels if self.is_established(number)))


class Refusals:
    """Interfaces and connections that could not be made; they are not tried again while they are the same."""

    def __init__(self) -> None:
        self._interfaces: dict[str, InterfaceSpec] = {}
        self._connections: dict[int, ConnectionSpec] = {}

    def add_interface(self, spec: InterfaceSpec) -> None:
        """Note an interface."""
        self._interfaces[spec.tag] = spec

    def add_connection(self, spec: ConnectionSpec) -> None:
        """Note a connection."""
        self._connections[spec.id] = spec

    def has_interface(self, tag: str) -> bool:
        """Return whether an interface was refused."""
        return tag in self._interfaces

    def has_connection(self, number: int) -> bool:
        """Return whether a connection was refused."""
        return number in self._connections

    def review(self, interfaces: Iterable[str], connections: Iterable[int], desired: DesiredState) -> None:
        """Forget those of some interfaces and connections that are desired otherwise now."""
        if self._interfaces:
            for tag in interfaces:
                if self._interfaces.get(tag) != desired.interfaces.get(tag):
                    self._interfaces.pop(tag, None)
        if self._connections:
            for number in connections:
                if self._connections.get(number) != desired.connections.get(number):
                    self._connections.pop(number, None)
