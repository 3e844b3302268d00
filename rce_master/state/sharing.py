"""Equal parts of records that are read from the store, kept once.

A decoder makes every text and every part of a record anew, although thousands of containers have the same
resources, run the same nodes and have interfaces of the same types, and an endpoint's id is in its row's key,
in its record and in the records of its interfaces, links and connections. Records and their parts are
immutable, so one copy of each serves all. That is half of the memory of a large state.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from msgspec.structs import force_setattr

from rce_master.state.records import Container

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

    from msgspec import Struct

    from rce.control import LinkAddress
    from rce.model import InterfaceSpec, NodeSpec
    from rce_master.state.records import Endpoint
    from rce_master.state.wiring_records import Connection, Interface, Link

T = TypeVar("T", bound="Hashable")

MOST = 4096
"""So many values are remembered; then all are forgotten, and those that still come are remembered again."""
LARGEST = 4096
"""Parts of longer rows, in bytes, are not remembered: they would stay when their records are gone."""


class Pool:
    """Values that came lately, each of them once. Its values must be immutable."""

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._values: dict[Hashable, Hashable] = {}

    def __len__(self) -> int:
        return len(self._values)

    def one(self, value: T) -> T:
        """Return the value that is kept for all values of its type that are equal to it."""
        found = self._values.get(value)
        if found is not None and type(found) is type(value):
            return found
        if len(self._values) >= self._most:
            self._values.clear()
        self._values[value] = value
        return value


class Sharing:
    """Makes records that were just decoded share what is equal. It changes no value.

    Args:
        kept_id: Returns the copy of an endpoint's id that its record has, or the id without such a record.
            Other records share it if they are read after the endpoints.
    """

    def __init__(self, kept_id: Callable[[str], str]) -> None:
        self._kept_id = kept_id
        self._texts = Pool()
        self._parts = Pool()

    def endpoint(self, key: str, record: Endpoint, size: int) -> None:
        """Share the parts of a robot or container; ``size`` is that of its row, in bytes."""
        if record.id == key:
            force_setattr(record, "id", self._kept_id(key))
        self._text(record, "task_set")
        if size > LARGEST or not isinstance(record, Container):
            return
        force_setattr(record, "resources", self._parts.one(record.resources))
        force_setattr(record, "address", self._address(record.address))
        for tag, node in record.nodes.items():
            record.nodes[tag] = self._node(node)

    def interface(self, _key: str, record: Interface, size: int) -> None:
        """Share the parts of an interface."""
        self._endpoint_id(record, "endpoint")
        if size <= LARGEST:
            force_setattr(record, "spec", self._interface(record.spec))

    def link(self, key: str, record: Link, _size: int) -> None:
        """Share the texts of a link."""
        if record.id == key:
            force_setattr(record, "id", key)
        for field in ("a", "b"):
            self._endpoint_id(record, field)

    def connection(self, _key: str, record: Connection, size: int) -> None:
        """Share the texts of a connection."""
        for field in ("a", "b"):
            self._endpoint_id(record, field)
        if size <= LARGEST:
            for field in ("link", "interface_a", "interface_b"):
                self._text(record, field)

    def _node(self, node: NodeSpec) -> NodeSpec:
        found = self._parts.one(node)
        if found is node:
            for field in ("tag", "pkg", "exe"):
                self._text(node, field)
        return found

    def _address(self, address: LinkAddress) -> LinkAddress:
        found = self._parts.one(address)
        if found is address:
            for field in ("machine", "host"):
                self._text(address, field)
        return found

    def _interface(self, spec: InterfaceSpec) -> InterfaceSpec:
        found = self._parts.one(spec)
        if found is spec:
            for field in ("tag", "type", "message_type", "addr"):
                self._text(spec, field)
        return found

    def _text(self, record: Struct, field: str) -> None:
        force_setattr(record, field, self._texts.one(getattr(record, field)))

    def _endpoint_id(self, record: Interface | Link | Connection, field: str) -> None:
        force_setattr(record, field, self._kept_id(getattr(record, field)))
