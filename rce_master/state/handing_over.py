"""The last part of a move: a container's copy makes its links, takes over, and the former container leaves.

The copy's links are made beside those of the container (:mod:`rce.link.takeover`). When the copy reports all
connections as established that are in use, it becomes the container. The former one is told to end when it
reports that its peers have closed their connections to it, which they do after the last answers. Both have a
limit in time; after it, the move continues as if they were done.

A departure does not outlive a restart of the master: ``Sync`` ends the former container then.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.control import EndpointState
from rce_master.state import endpoints
from rce_master.state.records import Departure, Tombstone
from rce_master.state.wiring_records import open_end_key

if TYPE_CHECKING:
    from rce.control import EndpointStatus, StatusPatch
    from rce_master.state.changes import Transaction
    from rce_master.state.records import Container, Move
    from rce_master.state.tables import Tables

_ENDING = frozenset({EndpointState.FAILED, EndpointState.STOPPING})


def in_use(tables: Tables, id_: str, company: frozenset[str]) -> frozenset[int]:
    """Return the established connections of a container to all endpoints but some, and itself."""
    found = set()
    for end in tables.open_ends.by("endpoint", id_):
        connection = tables.connections.get(str(end.connection))
        if connection is None:
            continue
        peer = connection.b if connection.a == id_ else connection.a
        if peer != id_ and peer not in company and open_end_key(peer, end.connection) in tables.open_ends:
            found.add(end.connection)
    return frozenset(found)


def may_link(tables: Tables, company: frozenset[str]) -> bool:
    """Whether copies of containers may make their links now: no peer is at the same."""
    for id_ in company:
        for link in tables.links.by("endpoint", id_):
            peer = link.peer(id_)
            move = tables.moves.get(peer)
            if peer not in company and move is not None and move.linking_since is not None:
                return False
    return True


def begin_links(tx: Transaction, move: Move) -> None:
    """Have a copy make its links, and its peers those to it."""
    tx.put(replace(move, linking_since=tx.now))
    tx.touch(move.id)
    endpoints.touch_dialers(tx, move.id)


def has_links(tx: Transaction, move: Move, company: frozenset[str]) -> bool:
    """Whether a copy has all links that are in use, or has had its time for them."""
    assert move.linking_since is not None
    if tx.now - move.linking_since >= tx.settings.link_timeout:
        return True
    return in_use(tx.tables, move.id, company) <= move.connections


def established(move: Move, status: EndpointStatus, patch: StatusPatch | None) -> frozenset[int]:
    """Return the established connections of a copy after a report, or a patch of one."""
    if patch is None:
        return frozenset(status.connections)
    return (move.connections - set(patch.lost_connections)) | set(patch.status.connections)


def depart(tx: Transaction, container: Container, connections: frozenset[int]) -> None:
    """Let a container give its last answers at its former machine, on these connections."""
    endpoints.end_departure(tx, container.id, "it was handed over again")
    status = tx.tables.container_live(container.id).status
    if status is None or not connections or not tx.tables.is_connected(container.task_set):
        endpoints.withdraw(tx, container, _WHY)
        return
    tx.put(Tombstone(process=container.task_set, id=container.id))
    tx.put(
        Departure(
            id=container.id,
            process=container.task_set,
            since=tx.now,
            number=status.number,
            connections=connections,
        )
    )


def departing_reported(
    tx: Transaction, process: str, status: EndpointStatus, patch: StatusPatch | None = None
) -> None:
    """Apply a report about a container at its former machine; ignore other ones."""
    departure = tx.tables.departures.get(status.id)
    if departure is None or departure.process != process:
        return
    if patch is None:
        left = departure.connections & set(status.connections)
    elif status.number == departure.number + 1:
        left = departure.connections - set(patch.lost_connections)
    else:
        tx.changes.wanted_statuses.append((process, status.id))
        return
    if left and status.state not in _ENDING:
        tx.put(replace(departure, number=status.number, connections=left))
    else:
        endpoints.end_departure(tx, status.id, _WHY)


def departed(tx: Transaction, process: str, id_: str) -> None:
    """Note that a container ended at its former machine."""
    departure = tx.tables.departures.get(id_)
    if departure is not None and departure.process == process:
        tx.delete(tx.tables.departures, id_)


def expire(tx: Transaction) -> None:
    """End containers at their former machines that take too long for their last answers."""
    for departure in list(tx.tables.departures):
        if tx.now - departure.since >= tx.settings.departure_timeout:
            endpoints.end_departure(tx, departure.id, _WHY)


_WHY = "it was handed over to another machine"
