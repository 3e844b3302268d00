"""What can be wrong with what is asked of a container, beyond the types of the keys. Pure.

One set of rules for the client protocol and for config files: both name the key as it is written there.
"""

from __future__ import annotations

import ipaddress
import re
from typing import TYPE_CHECKING, Any, NamedTuple

from rce.model.quantities import read_bandwidth, read_cores, read_memory

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from rce.protocol.messages import ContainerData, ResizeData

_READERS: dict[str, Callable[[object], float]] = {
    "cpu": read_cores,
    "memory": read_memory,
    "bandwidth": read_bandwidth,
}
# A folder of the machine, or an image's name as registries know it: no spaces, no option of a command line.
_IMAGE = re.compile(r"(/[^\x00-\x1f]*|[A-Za-z0-9][A-Za-z0-9._:/@+-]*)")
_MAX_IMAGE = 255

DEFAULT_PREFIX = 24
"""Of a ``groupIp`` that has none."""
_SHORTEST_PREFIX, _LONGEST_PREFIX = 8, 30


class Fault(NamedTuple):
    """One thing that is wrong."""

    key: str
    """As it is written on the wire."""
    problem: str


def container_faults(data: ContainerData) -> Iterator[Fault]:
    """Find what is wrong with the request for a container."""
    yield from _quantity_faults(data)
    yield from _network_faults(data)
    if data.image and (len(data.image) > _MAX_IMAGE or not _IMAGE.fullmatch(data.image)):
        yield Fault("image", "must be an image's name such as debian:12, or the path of a folder")


def resize_faults(data: ResizeData) -> Iterator[Fault]:
    """Find what is wrong with the new size of a container."""
    if all(getattr(data, key) is None for key in data.__struct_fields__):
        yield Fault("", f"says nothing; give one or more of {', '.join(data.__struct_fields__)}")
    yield from _quantity_faults(data)


def find_circle(start: str, after: Mapping[str, Sequence[str]]) -> list[str]:
    """Find a way on which a node comes after itself.

    Args:
        start: The node's tag.
        after: The tags of the nodes that each node comes after.

    Returns:
        The tags on the way, ``start`` first and last; empty if there is none.
    """
    ways = [[start, tag] for tag in after.get(start, ())]
    seen: set[str] = set()
    while ways:
        way = ways.pop()
        if way[-1] == start:
            return way
        if way[-1] not in seen:
            seen.add(way[-1])
            ways += [[*way, tag] for tag in after.get(way[-1], ())]
    return []


def _quantity_faults(data: ContainerData | ResizeData) -> Iterator[Fault]:
    for key, read in _READERS.items():
        value: Any = getattr(data, key)
        if value is None:
            continue
        try:
            read(value)
        except ValueError as error:
            yield Fault(key, str(error))


def _network_faults(data: ContainerData) -> Iterator[Fault]:
    if data.joins_group and not data.group:
        yield Fault("group", "is missing; a container in a network of containers names its group")
    if data.group_ip:
        problem = _address_problem(data.group_ip)
        if problem:
            yield Fault("groupIp", f"{problem}, not {data.group_ip!r:.60}")


def _address_problem(text: str) -> str:
    try:
        address = ipaddress.IPv4Interface(text if "/" in text else f"{text}/{DEFAULT_PREFIX}")
    except ValueError:
        return "must be an IPv4 address such as 10.0.0.2 or 10.0.0.2/24"
    network = address.network
    if not _SHORTEST_PREFIX <= network.prefixlen <= _LONGEST_PREFIX:
        return f"must have a prefix from /{_SHORTEST_PREFIX} to /{_LONGEST_PREFIX}"
    if address.ip in (network.network_address, network.broadcast_address):
        return f"must be an address of a host in {network}"
    return ""
