"""Checks of references within a client's config file.

A file may refer to containers and interfaces that other robots of the same user make. So a reference is wrong
only if the file itself shows that it cannot work.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from rce.config.exceptions import Fault
from rce.config.items import SPELLING, ItemOf
from rce.model import (
    AddInterface,
    AddNode,
    Connection,
    CreateContainer,
    Form,
    Network,
    Role,
    SetParameter,
    faults_of,
    find_circle,
    is_name,
    join_path,
)

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Iterator, Mapping
    from typing import Self


@dataclass
class Parts:
    """The valid items of a file, each with its index."""

    robot: str | None
    complete: bool = True
    """Whether every interface of the file is among them."""
    containers: list[tuple[int, CreateContainer]] = field(default_factory=list)
    nodes: list[tuple[int, AddNode]] = field(default_factory=list)
    parameters: list[tuple[int, SetParameter]] = field(default_factory=list)
    interfaces: list[tuple[int, AddInterface]] = field(default_factory=list)
    connections: list[tuple[int, Connection]] = field(default_factory=list)
    origins: Mapping[tuple[str, int], str] = field(default_factory=dict)
    """Places in the file that ask for items that it does not list itself, by key and index."""

    def place(self, key: str, index: int, field_: str = "") -> str:
        """Return the place of an item, or of one of its fields, in the file."""
        origin = self.origins.get((key, index))
        return origin or (f"{key}[{index}].{field_}" if field_ else f"{key}[{index}]")

    @classmethod
    def salvage(cls, data: Mapping[str, Any], kinds: Mapping[str, ItemOf[Any]]) -> Self:
        """Return the valid items of a document; others may be wrong."""
        robot = data.get("robotID")
        parts = cls(robot if isinstance(robot, str) and is_name(robot) else None)
        for key, kind in kinds.items():
            items = data.get(key, [])
            good = getattr(parts, key)
            for index, item in enumerate(items if isinstance(items, list) else []):
                try:
                    good.append((index, kind.read(item)))
                except ValidationError:
                    continue  # reported with the whole document
            if key == "interfaces" and (not isinstance(items, list) or len(good) < len(items)):
                parts.complete = False
        parts.complete = parts.complete and not data.get("bridges")
        return parts


def credential_faults(data: Mapping[str, Any]) -> list[Fault]:
    """Check that a document has one credential: a password or a token."""
    given = [key for key in ("password", "token") if data.get(key) not in (None, "")]
    if len(given) == 1:
        return []
    if given:
        return [Fault("token", "cannot be given beside a password; leave one of the two out")]
    what = "must be the user's password, or leave it out and give a token (rce robot add ROBOT)"
    return [Fault("password", f"is missing: {what}" if "password" not in data else what)]


def check(parts: Parts) -> list[Fault]:
    """Find every conflict between items."""
    return [
        *_check_tags(parts),
        *_check_containers(parts),
        *_check_order(parts),
        *_check_interfaces(parts),
        *_check_connections(parts),
    ]


def _check_tags(parts: Parts) -> Iterator[Fault]:
    for index, container in parts.containers:
        if container.tag == parts.robot:
            yield Fault(f"containers[{index}].cTag", f"{container.tag!r} is the robot's own name")
    yield from _repeated(parts, "containers", "cTag", ((i, item.tag) for i, item in parts.containers))
    yield from _repeated(
        parts, "nodes", "nTag", ((i, (item.container, item.node.tag)) for i, item in parts.nodes)
    )
    yield from _repeated(
        parts,
        "parameters",
        "name",
        ((i, (item.container, item.parameter.name)) for i, item in parts.parameters),
    )
    yield from _repeated(parts, "interfaces", "iTag", ((i, item.path) for i, item in parts.interfaces))
    yield from _repeated(
        parts, "connections", "", ((i, frozenset((item.tag_a, item.tag_b))) for i, item in parts.connections)
    )
    for index, node in parts.nodes:
        if node.container == parts.robot:
            yield Fault(f"nodes[{index}].cTag", f"{node.container!r} is the robot, not a container")
    for index, parameter in parts.parameters:
        if parameter.container == parts.robot:
            yield Fault(f"parameters[{index}].cTag", f"{parameter.container!r} is the robot, not a container")


def _repeated(parts: Parts, key: str, field_: str, items: Iterable[tuple[int, Hashable]]) -> Iterator[Fault]:
    first: dict[Hashable, int] = {}
    for index, identity in items:
        if identity in first:
            problem = f"is the same as in {parts.place(key, first[identity])}"
            yield Fault(parts.place(key, index, field_), problem)
        first.setdefault(identity, index)


def _check_containers(parts: Parts) -> Iterator[Fault]:
    addresses: dict[Hashable, int] = {}
    for index, container in parts.containers:
        place = f"containers[{index}]"
        for fault in faults_of(container):
            key = join_path(SPELLING.path(CreateContainer, fault.path))
            yield Fault(f"{place}.{key}", fault.problem)
        wanted = container.resources
        if wanted.network is Network.GROUP and wanted.group_ip:
            first = addresses.setdefault((wanted.group, wanted.group_ip.partition("/")[0]), index)
            if first != index:
                problem = f"is the address of containers[{first}] in the group {wanted.group!r}"
                yield Fault(f"{place}.groupIp", problem)


def _check_order(parts: Parts) -> Iterator[Fault]:
    """Find nodes that wait for one another in a cycle."""
    after: dict[str, dict[str, tuple[str, ...]]] = {}
    for _, node in parts.nodes:
        after.setdefault(node.container, {})[node.node.tag] = node.node.after
    for index, node in parts.nodes:
        circle = find_circle(node.node.tag, after[node.container])
        if circle:
            yield Fault(f"nodes[{index}].after", f"goes round in a circle: {' after '.join(circle)}")


def _check_interfaces(parts: Parts) -> Iterator[Fault]:
    containers = {item.tag for _, item in parts.containers}
    for index, item in parts.interfaces:
        type_ = item.interface.type
        if item.interface.kind.form is Form.INTERFACE:
            if not item.interface.addr:
                problem = f"is missing; a {type_} needs the ROS name in the container"
                yield Fault(parts.place("interfaces", index, "addr"), problem)
            if item.endpoint == parts.robot:
                problem = f"a {type_} belongs in a container; a robot has Converters and Forwarders"
                yield Fault(parts.place("interfaces", index, "iType"), problem)
        elif item.endpoint in containers:
            problem = f"a {type_} belongs on a robot; a container has Interfaces"
            yield Fault(parts.place("interfaces", index, "iType"), problem)


def _check_connections(parts: Parts) -> Iterator[Fault]:
    interfaces = {item.path: item for _, item in parts.interfaces}
    ours = {item.tag for _, item in parts.containers} | {parts.robot}
    providers: dict[str, int] = {}
    for index, link in parts.connections:
        for key, path in (("tagA", link.tag_a), ("tagB", link.tag_b)):
            item = interfaces.get(path)
            if item is None:
                if parts.complete and path.partition("/")[0] in ours:
                    place = parts.place("connections", index, key)
                    yield Fault(place, f"there is no interface {path!r} in this file")
            elif item.interface.kind.role is Role.SERVICE_PROVIDER:
                if path in providers:
                    other = parts.place("connections", providers[path])
                    problem = f"{path!r} takes one connection, and that is in {other}"
                    yield Fault(parts.place("connections", index, key), problem)
                providers.setdefault(path, index)
        if link.tag_a in interfaces and link.tag_b in interfaces:
            place = parts.place("connections", index)
            yield from _check_pair(place, interfaces[link.tag_a], interfaces[link.tag_b])


def _check_pair(place: str, a: AddInterface, b: AddInterface) -> Iterator[Fault]:
    one, other = a.interface, b.interface
    needed = one.kind.role.complement
    if other.kind.role is not needed:
        problem = f"{a.path} is a {one.type} and needs a {needed.value}, but {b.path} is a {other.type}"
        yield Fault(place, problem)
    if one.message_type != other.message_type:
        problem = f"{a.path} carries {one.message_type}, but {b.path} carries {other.message_type}"
        yield Fault(place, problem)
