"""Reports about interfaces and connections: which are in use now."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_master.state.wiring_records import ActiveInterface, OpenEnd, interface_key, open_end_key

if TYPE_CHECKING:
    from rce.control import EndpointStatus, StatusPatch
    from rce_master.state.changes import Transaction


def note(tx: Transaction, status: EndpointStatus) -> None:
    """Apply a whole report about an endpoint's interfaces and connections."""
    id_, tables = status.id, tx.tables
    active = {tag for tag, is_active in status.interfaces.items() if is_active}
    for interface in tables.active.by("endpoint", id_):
        if interface.tag not in active:
            tx.delete(tables.active, interface.id)
    for tag in active:
        tx.put(ActiveInterface(endpoint=id_, tag=tag))
    established = set(status.connections)
    for end in tables.open_ends.by("endpoint", id_):
        if end.connection not in established:
            tx.delete(tables.open_ends, end.id)
    for connection in established:
        tx.put(OpenEnd(endpoint=id_, connection=connection))


def amend(tx: Transaction, patch: StatusPatch) -> None:
    """Apply the changes of a report."""
    id_, tables = patch.status.id, tx.tables
    for tag in patch.removed_interfaces:
        tx.delete(tables.active, interface_key(id_, tag))
    for tag, is_active in patch.status.interfaces.items():
        if is_active:
            tx.put(ActiveInterface(endpoint=id_, tag=tag))
        else:
            tx.delete(tables.active, interface_key(id_, tag))
    for connection in patch.lost_connections:
        tx.delete(tables.open_ends, open_end_key(id_, connection))
    for connection in patch.status.connections:
        tx.put(OpenEnd(endpoint=id_, connection=connection))


def forget(tx: Transaction, id_: str) -> None:
    """Forget the reports about an endpoint."""
    for interface in tx.tables.active.by("endpoint", id_):
        tx.delete(tx.tables.active, interface.id)
    for end in tx.tables.open_ends.by("endpoint", id_):
        tx.delete(tx.tables.open_ends, end.id)
