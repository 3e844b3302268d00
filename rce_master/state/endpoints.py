"""Functions for robots and containers: removal, addresses, and which end dials."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from rce.control import EndpointKind, LinkAddress
from rce_master.exceptions import LimitReachedError
from rce_master.state import activity, saved_states, volumes
from rce_master.state.records import Container, Endpoint, Robot, Tombstone

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.tables import Tables
    from rce_master.state.wiring_records import Connection, Link

_REMOVAL = 100
"""The work of removing an endpoint or a connection, as :attr:`StateSettings.max_work` counts it."""
_INTERFACE = 10
"""The work of removing an interface."""
_TOUCH = 10
"""The work of telling a peer of a place."""
_SMALL = 32 * 2**10
"""Endpoints up to this size are not checked: their number limits them sufficiently."""


def size_of(part: object) -> int:
    """Return how many bytes a node, a parameter or an interface takes when it is encoded."""
    return len(msgspec.json.encode(part))


def grown(tx: Transaction, endpoint: Endpoint, part: object, instead_of: object = None) -> int:
    """Return an endpoint's size with a new part.

    Raises:
        LimitReachedError: It, or all endpoints of its user, would be too large.
    """
    settings = tx.settings
    size = endpoint.size + size_of(part) - (0 if instead_of is None else size_of(instead_of))
    if size > settings.max_endpoint_bytes:
        raise LimitReachedError(f"{endpoint.tag!r} would hold more than {settings.max_endpoint_bytes} bytes")
    if size > _SMALL:
        there = tx.tables.endpoints.get(endpoint.id)
        others = tx.tables.endpoints.total(endpoint.user) - (there.size if there is not None else 0)
        if others + size > settings.max_user_bytes:
            raise LimitReachedError(
                f"your robots and containers would hold more than {settings.max_user_bytes} bytes"
            )
    return size


def removal_work(tables: Tables, id_: str) -> int:
    """Return the work of :func:`remove`."""
    connections, interfaces = (one.count("endpoint", id_) for one in (tables.connections, tables.interfaces))
    return _REMOVAL * (1 + connections) + _INTERFACE * interfaces


def remove(tx: Transaction, id_: str, reason: str) -> None:
    """Remove an endpoint with its links and have its task set drop it."""
    endpoint = tx.tables.endpoints[id_]
    drop_copy(tx, id_, reason)
    end_departure(tx, id_, reason)
    if isinstance(endpoint, Container):
        volumes.end_move(tx, endpoint)
    for connection in tx.tables.connections.by("endpoint", id_):
        remove_connection(tx, connection)
    for interface in tx.tables.interfaces.by("endpoint", id_):
        tx.delete(tx.tables.interfaces, interface.id)
    activity.forget(tx, id_)
    tx.delete(tx.tables.endpoints, id_)
    tx.delete(tx.tables.live, id_)
    if isinstance(endpoint, Container):
        volumes.release(tx, endpoint)
        saved_states.forget(tx, id_)
    if endpoint.task_set:
        withdraw(tx, endpoint, reason)


def remove_connection(tx: Transaction, connection: Connection) -> None:
    """Remove a connection, and its link with the last one."""
    tx.delete(tx.tables.connections, str(connection.id))
    tx.touch_connection(connection)
    if not tx.tables.connections.count("link", connection.link):
        tx.delete(tx.tables.links, connection.link)
        for endpoint in (connection.a, connection.b):
            tx.touch_link(endpoint, connection.link)


def new_epoch(tx: Transaction) -> int:
    """Return an epoch that is greater than all before, also those after a backup that was restored."""
    return tx.next_number("revision")


def assign(tx: Transaction, endpoint: Endpoint, process: str, *, epoch: int = 0) -> None:
    """Make a task set responsible for an endpoint; it was not before.

    Peers that it dials take no links from its former place any more, which may not know that it was left: a
    machine that hung or was cut off continues to dial when it comes back.

    Args:
        tx: The transaction.
        endpoint: The endpoint.
        process: The task set.
        epoch: The endpoint's there; 0: a new one.
    """
    tx.put(msgspec.structs.replace(endpoint, task_set=process, epoch=epoch or new_epoch(tx)))
    tx.touch(endpoint.id)
    for link in tx.tables.links.by("endpoint", endpoint.id):
        peer = link.peer(endpoint.id)
        if peer != endpoint.id and dials(tx.tables, link, endpoint.id):
            tx.touch_link(endpoint.id, link.id)
            tx.touch_link(peer, link.id)
            tx.spend(_TOUCH)


def withdraw(tx: Transaction, endpoint: Endpoint, reason: str, *, elsewhere: bool = False) -> None:
    """Have the endpoint's present task set drop it.

    A task set that is away learns it from ``Sync`` when it comes back. The arguments are those of
    :meth:`Transaction.withdraw`.
    """
    if not tx.tables.is_connected(endpoint.task_set):
        return
    tx.withdraw(endpoint.task_set, endpoint.id, reason, elsewhere=elsewhere)
    if isinstance(endpoint, Container):
        tx.put(Tombstone(process=endpoint.task_set, id=endpoint.id))


def drop_copy(tx: Transaction, id_: str, reason: str) -> None:
    """Drop the copy of a container that is being handed over, if it exists."""
    move = tx.tables.moves.get(id_)
    if move is None:
        return
    tx.delete(tx.tables.moves, id_)
    if move.linking_since is not None:
        touch_dialers(tx, id_)
    if tx.tables.is_connected(move.to):
        tx.withdraw(move.to, id_, reason)
        tx.put(Tombstone(process=move.to, id=id_))


def end_departure(tx: Transaction, id_: str, reason: str) -> None:
    """Drop a container at its former machine, if it still gives its last answers there."""
    departure = tx.tables.departures.get(id_)
    if departure is None:
        return
    tx.delete(tx.tables.departures, id_)
    if tx.tables.is_connected(departure.process):
        tx.withdraw(departure.process, id_, reason)


def dials(tables: Tables, link: Link, endpoint: str) -> bool:
    """Tell whether this end of a link dials: a robot's end the container's, else the smaller id."""
    kind = tables.endpoints[endpoint].kind
    peer_kind = tables.endpoints[link.peer(endpoint)].kind
    if kind is peer_kind:
        return endpoint == link.a
    return kind is EndpointKind.ROBOT


def address(tables: Tables, id_: str) -> LinkAddress:
    """Tell where an endpoint accepts links; empty while it is not up."""
    endpoint = tables.endpoints[id_]
    if isinstance(endpoint, Robot):
        task_set = tables.task_sets.get(endpoint.task_set)
        return task_set.address if task_set else LinkAddress()
    return endpoint.address


def note_address(tx: Transaction, id_: str, address: LinkAddress) -> None:
    """Note where a container accepts links."""
    container = tx.tables.endpoints[id_]
    assert isinstance(container, Container)
    if container.address != address:
        tx.put(msgspec.structs.replace(container, address=address))
        touch_dialers(tx, id_)


def touch_dialers(tx: Transaction, id_: str) -> None:
    """Touch the links of all endpoints that dial this one: its address changed."""
    for link in tx.tables.links.by("endpoint", id_):
        if not dials(tx.tables, link, id_):
            tx.touch_link(link.peer(id_), link.id)
