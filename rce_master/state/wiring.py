"""Interfaces and connections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.model.names import Form, InterfaceType, Role
from rce_master.exceptions import Conflict, Invalid, LimitReached, NotFound
from rce_master.state import endpoints
from rce_master.state.records import Connection, Container, Endpoint, Link

if TYPE_CHECKING:
    from rce.model.specs import InterfaceSpec
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import AddInterface, Connect, Disconnect, RemoveInterface


def add_interface(tx: Transaction, command: AddInterface) -> None:
    """Make an interface; the same one again is accepted silently."""
    endpoint = _endpoint(tx, command.user, command.endpoint)
    interface = _checked(endpoint, command.interface)
    there = endpoint.interfaces.get(interface.tag)
    if there == interface:
        return
    if there is not None:
        raise Conflict(
            f"interface {_path(endpoint, interface.tag)!r} exists with other settings; remove it first"
        )
    if len(endpoint.interfaces) >= tx.settings.max_interfaces:
        raise LimitReached(f"{endpoint.tag!r} has {tx.settings.max_interfaces} interfaces already")
    size = endpoints.grown(tx, endpoint, interface)
    tx.put(replace(endpoint, interfaces={**endpoint.interfaces, interface.tag: interface}, size=size))
    tx.touch(endpoint.id)


def _checked(endpoint: Endpoint, interface: InterfaceSpec) -> InterfaceSpec:
    path = _path(endpoint, interface.tag)
    try:
        type_ = InterfaceType.parse(interface.type)
    except ValueError as error:
        raise Invalid(f"interface {path!r}: {error}") from None
    if not isinstance(endpoint, Container):
        if type_.form is Form.INTERFACE:
            raise Invalid(
                f"interface {path!r}: {type_} is for containers; a robot takes "
                f"{type_.role.value}Converter or {type_.role.value}Forwarder"
            )
        # Clients may name their local topic here; it means nothing to the engine.
        return replace(interface, addr="")
    if type_.form is not Form.INTERFACE:
        raise Invalid(
            f"interface {path!r}: {type_} is for robots; a container takes {type_.role.value}Interface"
        )
    if not interface.addr:
        raise Invalid(f"interface {path!r}: addr is missing; give the ROS name of the topic or service")
    return interface


def remove_interface(tx: Transaction, command: RemoveInterface) -> None:
    """Remove an interface with its connections."""
    endpoint = _endpoint(tx, command.user, command.endpoint)
    if command.tag not in endpoint.interfaces:
        raise NotFound(f"there is no interface {_path(endpoint, command.tag)!r}")
    kept = {t: i for t, i in endpoint.interfaces.items() if t != command.tag}
    size = endpoint.size - endpoints.size_of(endpoint.interfaces[command.tag])
    tx.put(replace(endpoint, interfaces=kept, size=size))
    tx.touch(endpoint.id)
    for link in tx.tables.links.by("endpoint", endpoint.id):
        rest = {
            n: c for n, c in link.connections.items() if command.tag not in _ends_at(link, c, endpoint.id)
        }
        if len(rest) < len(link.connections):
            tx.put_link(replace(link, connections=rest))


def connect(tx: Transaction, command: Connect) -> None:
    """Join two interfaces; joined ones are accepted silently."""
    pair = _pair(tx, command.user, command.tag_a, command.tag_b)
    link = tx.tables.link_between(pair.a.id, pair.b.id)
    if link is not None and _connection(link, pair) is not None:
        return
    _check_pair(tx, pair)
    if link is None:
        number = tx.next_number("link")
        link = Link(id=f"link{number}", a=pair.a.id, b=pair.b.id, token=tx.new_token())
    id_ = tx.next_number("connection")
    made = Connection(id=id_, interface_a=pair.interface_a.tag, interface_b=pair.interface_b.tag)
    tx.put_link(replace(link, connections={**link.connections, id_: made}))


def disconnect(tx: Transaction, command: Disconnect) -> None:
    """Part two interfaces."""
    pair = _pair(tx, command.user, command.tag_a, command.tag_b)
    link = tx.tables.link_between(pair.a.id, pair.b.id)
    connection = link and _connection(link, pair)
    if link is None or connection is None:
        raise NotFound(f"{command.tag_a!r} and {command.tag_b!r} are not connected")
    rest = {n: c for n, c in link.connections.items() if n != connection.id}
    tx.put_link(replace(link, connections=rest))


@dataclass(frozen=True, slots=True)
class _Pair:
    """Two interfaces, in the order of their endpoints' ids; of one endpoint in the order of their tags."""

    a: Endpoint
    interface_a: InterfaceSpec
    b: Endpoint
    interface_b: InterfaceSpec


def _pair(tx: Transaction, user: str, tag_a: str, tag_b: str) -> _Pair:
    one, other = _locate(tx, user, tag_a), _locate(tx, user, tag_b)
    ends = sorted((one, other), key=lambda end: (end[0].id, end[1].tag))
    (a, interface_a), (b, interface_b) = ends
    return _Pair(a, interface_a, b, interface_b)


def _locate(tx: Transaction, user: str, path: str) -> tuple[Endpoint, InterfaceSpec]:
    tag, slash, interface_tag = path.partition("/")
    if not slash:
        raise Invalid(f"{path!r} does not name an interface; write ENDPOINT/INTERFACE")
    endpoint = _endpoint(tx, user, tag)
    interface = endpoint.interfaces.get(interface_tag)
    if interface is None:
        raise NotFound(f"there is no interface {path!r}; add it first")
    return endpoint, interface


def _check_pair(tx: Transaction, pair: _Pair) -> None:
    one, other = pair.interface_a, pair.interface_b
    path_a, path_b = _path(pair.a, one.tag), _path(pair.b, other.tag)
    role_a, role_b = InterfaceType.parse(one.type).role, InterfaceType.parse(other.type).role
    if role_a.complement is not role_b:
        raise Invalid(
            f"{path_a!r} is a {one.type} and {path_b!r} a {other.type}: they do not complete each other; "
            f"a {role_a.value} connects to a {role_a.complement.value}"
        )
    if one.message_type != other.message_type:
        raise Invalid(
            f"{path_a!r} has the class {one.message_type} and {path_b!r} {other.message_type}; "
            "they must be the same"
        )
    for endpoint, interface, role in ((pair.a, one, role_a), (pair.b, other, role_b)):
        _check_room(tx, endpoint, interface, role)


def _check_room(tx: Transaction, endpoint: Endpoint, interface: InterfaceSpec, role: Role) -> None:
    links = tx.tables.links.by("endpoint", endpoint.id)
    if role is Role.SERVICE_PROVIDER:
        taken = any(
            interface.tag in _ends_at(link, c, endpoint.id)
            for link in links
            for c in link.connections.values()
        )
        if taken:
            raise Conflict(
                f"{_path(endpoint, interface.tag)!r} is a ServiceProvider and connected already; "
                "it takes one connection: disconnect it first"
            )
    if sum(len(link.connections) for link in links) >= tx.settings.max_connections:
        raise LimitReached(f"{endpoint.tag!r} has {tx.settings.max_connections} connections already")


def _connection(link: Link, pair: _Pair) -> Connection | None:
    wanted = (pair.interface_a.tag, pair.interface_b.tag)
    return next((c for c in link.connections.values() if (c.interface_a, c.interface_b) == wanted), None)


def _ends_at(link: Link, connection: Connection, endpoint: str) -> tuple[str, ...]:
    """Return the tags of the interfaces of an endpoint that a connection joins: both, if it has no other."""
    ends = ((link.a, connection.interface_a), (link.b, connection.interface_b))
    return tuple(tag for id_, tag in ends if id_ == endpoint)


def _endpoint(tx: Transaction, user: str, tag: str) -> Endpoint:
    found = tx.tables.endpoints.get(f"{user}/{tag}")
    if found is None:
        raise NotFound(
            f"there is no robot or container {tag!r}; robots must be connected, containers created"
        )
    return found


def _path(endpoint: Endpoint, interface: str) -> str:
    return f"{endpoint.tag}/{interface}"
