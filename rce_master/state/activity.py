"""What is reported of interfaces and connections: which are in use now."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce_master.state.wiring_records import ActiveInterface, OpenEnd

if TYPE_CHECKING:
    from rce.control.model import EndpointStatus
    from rce_master.state.changes import Transaction


def note(tx: Transaction, status: EndpointStatus) -> EndpointStatus:
    """Note all that a whole report says of an endpoint's interfaces and connections; return the rest."""
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
    return replace(status, interfaces={}, connections=())


def forget(tx: Transaction, id_: str) -> None:
    """Note that nothing is known of an endpoint any more."""
    for interface in tx.tables.active.by("endpoint", id_):
        tx.delete(tx.tables.active, interface.id)
    for end in tx.tables.open_ends.by("endpoint", id_):
        tx.delete(tx.tables.open_ends, end.id)
