"""Interfaces and connections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.model import Form, InterfaceSpec, InterfaceType, Role
from rce_master.exceptions import ConflictError, InvalidRequestError, LimitReachedError, NotFoundError
from rce_master.state import endpoints
from rce_master.state.records import Container, Endpoint
from rce_master.state.wiring_records import Connection, Interface, Link, interface_key

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import AddInterface, Connect, Disconnect, RemoveInterface


def add_interface(tx: Transaction, command: AddInterface) -> None:
    """Make an interface; the same one again is accepted silently."""
    endpoint = _endpoint(tx, command.user, command.endpoint)
    interface = _checked(endpoint, command.interface)
    there = tx.tables.interface(endpoint.id, interface.tag)
    if there == interface:
        return
    if there is not None:
        raise ConflictError(
            f"interface {_path(endpoint, interface.tag)!r} exists with other settings; remove it first"
        )
    if tx.tables.interfaces.count("endpoint", endpoint.id) >= tx.settings.max_interfaces:
        raise LimitReachedError(f"{endpoint.tag!r} has {tx.settings.max_interfaces} interfaces already")
    if tx.tables.interfaces.count("user", endpoint.user) >= tx.settings.max_user_interfaces:
        raise LimitReachedError(
            f"you have {tx.settings.max_user_interfaces} interfaces already; remove some first"
        )
    size = endpoints.grown(tx, endpoint, interface)
    tx.put(replace(endpoint, size=size))
    tx.put(Interface(endpoint=endpoint.id, number=tx.next_number("interface"), spec=interface))
    tx.touch_interface(endpoint.id, interface.tag)


def _checked(endpoint: Endpoint, interface: InterfaceSpec) -> InterfaceSpec:
    path = _path(endpoint, interface.tag)
    try:
        type_ = InterfaceType.parse(interface.type)
    except ValueError as error:
        raise InvalidRequestError(f"interface {path!r}: {error}") from None
    if not isinstance(endpoint, Container):
        if type_.form is Form.INTERFACE:
            raise InvalidRequestError(
                f"interface {path!r}: {type_} is for containers; a robot takes "
                f"{type_.role.value}Converter or {type_.role.value}Forwarder"
            )
        # Clients may name their local topic here; it means nothing to the engine.
        return replace(interface, addr="")
    if type_.form is not Form.INTERFACE:
        raise InvalidRequestError(
            f"interface {path!r}: {type_} is for robots; a container takes {type_.role.value}Interface"
        )
    if not interface.addr:
        raise InvalidRequestError(
            f"interface {path!r}: addr is missing; give the ROS name of the topic or service"
        )
    return interface


def remove_interface(tx: Transaction, command: RemoveInterface) -> None:
    """Remove an interface with its connections."""
    endpoint = _endpoint(tx, command.user, command.endpoint)
    interface = tx.tables.interface(endpoint.id, command.tag)
    if interface is None:
        raise NotFoundError(f"there is no interface {_path(endpoint, command.tag)!r}")
    tx.put(replace(endpoint, size=endpoint.size - endpoints.size_of(interface)))
    key = interface_key(endpoint.id, command.tag)
    tx.delete(tx.tables.interfaces, key)
    tx.touch_interface(endpoint.id, command.tag)
    for connection in tx.tables.connections.by("end", key):
        endpoints.remove_connection(tx, connection)


def connect(tx: Transaction, command: Connect) -> None:
    """Join two interfaces; joined ones are accepted silently."""
    pair = _pair(tx, command.user, command.tag_a, command.tag_b)
    link = tx.tables.link_between(pair.a.id, pair.b.id)
    if _connection(tx, pair) is not None:
        return
    _check_pair(tx, pair)
    limit = tx.settings.max_link_connections
    if link is not None and tx.tables.connections.count("link", link.id) >= limit:
        raise LimitReachedError(f"{pair.a.tag!r} and {pair.b.tag!r} have {limit} connections already")
    if link is None:
        number = tx.next_number("link")
        link = Link(id=f"link{number}", a=pair.a.id, b=pair.b.id, token=tx.new_token())
        tx.put(link)
        for endpoint in (link.a, link.b):
            tx.touch_link(endpoint, link.id)
    made = Connection(
        id=tx.next_number("connection"),
        link=link.id,
        a=link.a,
        interface_a=pair.interface_a.tag,
        b=link.b,
        interface_b=pair.interface_b.tag,
    )
    tx.put(made)
    tx.touch_connection(made)


def disconnect(tx: Transaction, command: Disconnect) -> None:
    """Part two interfaces."""
    pair = _pair(tx, command.user, command.tag_a, command.tag_b)
    connection = _connection(tx, pair)
    if connection is None:
        raise NotFoundError(f"{command.tag_a!r} and {command.tag_b!r} are not connected")
    endpoints.remove_connection(tx, connection)


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
        raise InvalidRequestError(f"{path!r} does not name an interface; write ENDPOINT/INTERFACE")
    endpoint = _endpoint(tx, user, tag)
    interface = tx.tables.interface(endpoint.id, interface_tag)
    if interface is None:
        raise NotFoundError(f"there is no interface {path!r}; add it first")
    return endpoint, interface


def _check_pair(tx: Transaction, pair: _Pair) -> None:
    one, other = pair.interface_a, pair.interface_b
    path_a, path_b = _path(pair.a, one.tag), _path(pair.b, other.tag)
    role_a, role_b = InterfaceType.parse(one.type).role, InterfaceType.parse(other.type).role
    if role_a.complement is not role_b:
        raise InvalidRequestError(
            f"{path_a!r} is a {one.type} and {path_b!r} a {other.type}: they do not complete each other; "
            f"a {role_a.value} connects to a {role_a.complement.value}"
        )
    if one.message_type != other.message_type:
        raise InvalidRequestError(
            f"{path_a!r} has the class {one.message_type} and {path_b!r} {other.message_type}; "
            "they must be the same"
        )
    if tx.tables.connections.count("user", pair.a.user) >= tx.settings.max_user_connections:
        raise LimitReachedError(
            f"you have {tx.settings.max_user_connections} connections already; remove some first"
        )
    for endpoint, interface, role in ((pair.a, one, role_a), (pair.b, other, role_b)):
        _check_room(tx, endpoint, interface, role)


def _check_room(tx: Transaction, endpoint: Endpoint, interface: InterfaceSpec, role: Role) -> None:
    connections = tx.tables.connections
    if role is Role.SERVICE_PROVIDER and connections.count("end", interface_key(endpoint.id, interface.tag)):
        raise ConflictError(
            f"{_path(endpoint, interface.tag)!r} is a ServiceProvider and connected already; "
            "it takes one connection: disconnect it first"
        )
    if connections.count("endpoint", endpoint.id) >= tx.settings.max_connections:
        raise LimitReachedError(f"{endpoint.tag!r} has {tx.settings.max_connections} connections already")


def _connection(tx: Transaction, pair: _Pair) -> Connection | None:
    ends = (
        interface_key(pair.a.id, pair.interface_a.tag),
        interface_key(pair.b.id, pair.interface_b.tag),
    )
    return next(iter(tx.tables.connections.by("ends", " ".join(ends))), None)


def _endpoint(tx: Transaction, user: str, tag: str) -> Endpoint:
    found = tx.tables.endpoints.get(f"{user}/{tag}")
    if found is None:
        raise NotFoundError(
            f"there is no robot or container {tag!r}; robots must be connected, containers created"
        )
    return found


def _path(endpoint: Endpoint, interface: str) -> str:
    return f"{endpoint.tag}/{interface}"
