"""Converts stores of the previous release, whose endpoints and links contain interfaces and connections.

Pure. Converted records stay as they are, so an interrupted conversion can be repeated.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import Struct

from rce.model import InterfaceSpec
from rce_master.exceptions import StoreError
from rce_master.state.records import Counter
from rce_master.state.wiring_records import Connection, Interface
from rce_master.store.base import Row, Snapshot

if TYPE_CHECKING:
    from collections.abc import Iterator


_ENDPOINTS, _LINKS, _INTERFACES, _CONNECTIONS = "endpoints", "links", "interfaces", "connections"
_COUNTERS, _NUMBER = "counters", "interface"


class _OldEndpoint(Struct):
    id: str
    interfaces: dict[str, InterfaceSpec] = {}


class _OldConnection(Struct):
    id: int
    interface_a: str
    interface_b: str


class _OldLink(Struct):
    id: str
    a: str
    b: str
    connections: dict[int, _OldConnection] = {}


_read_endpoint = msgspec.json.Decoder(_OldEndpoint).decode
_read_link = msgspec.json.Decoder(_OldLink).decode
_read_counter = msgspec.json.Decoder(Counter).decode
_write = msgspec.json.encode


def conversion(snapshot: Snapshot) -> list[Row]:
    """Return the rows that convert a store of the previous release to this release.

    Raises:
        StoreError: A record cannot be read.
    """
    try:
        return [*_interfaces(snapshot), *_connections(snapshot)]
    except msgspec.MsgspecError as error:
        raise StoreError(f"a record in the store cannot be read: {error}") from error


def converted(snapshot: Snapshot) -> Snapshot:
    """Return the contents of a store in the form of this release.

    Raises:
        StoreError: A record cannot be read.
    """
    rows = conversion(snapshot)
    if not rows:
        return snapshot
    tables = {name: dict(table) for name, table in snapshot.items()}
    for row in rows:
        assert row.body is not None
        tables.setdefault(row.table, {})[row.key] = row.body
    return tables


def _interfaces(snapshot: Snapshot) -> Iterator[Row]:
    stored = snapshot.get(_COUNTERS, {}).get(_NUMBER)
    first = 0 if stored is None else _read_counter(stored).value
    numbers = itertools.count(first + 1)
    newest = first
    for key, body in snapshot.get(_ENDPOINTS, {}).items():
        endpoint = _read_endpoint(body)
        if not endpoint.interfaces:
            continue
        for spec in endpoint.interfaces.values():
            newest = next(numbers)
            interface = Interface(endpoint=endpoint.id, number=newest, spec=spec)
            yield Row(_INTERFACES, interface.id, _write(interface))
        yield Row(_ENDPOINTS, key, _without(body, "interfaces"))
    if newest > first:
        yield Row(_COUNTERS, _NUMBER, _write(Counter(name=_NUMBER, value=newest)))


def _connections(snapshot: Snapshot) -> Iterator[Row]:
    for key, body in snapshot.get(_LINKS, {}).items():
        link = _read_link(body)
        if not link.connections:
            continue
        for old in link.connections.values():
            connection = Connection(
                id=old.id,
                link=link.id,
                a=link.a,
                interface_a=old.interface_a,
                b=link.b,
                interface_b=old.interface_b,
            )
            yield Row(_CONNECTIONS, str(old.id), _write(connection))
        yield Row(_LINKS, key, _without(body, "connections"))


def _without(body: bytes, field: str) -> bytes:
    record: dict[str, Any] = msgspec.json.decode(body)
    del record[field]
    return _write(record)
