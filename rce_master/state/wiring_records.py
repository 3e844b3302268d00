"""The records of interfaces and of what joins them: one each, so that a change writes only what it changes.

All are immutable: a change replaces a record. :class:`ActiveInterface` and :class:`OpenEnd` are what is
observed now; the others go to the store.
"""

from __future__ import annotations

from msgspec import Struct

from rce.model import InterfaceSpec


class Interface(Struct, frozen=True, kw_only=True):
    """An interface of an endpoint."""

    endpoint: str
    """Endpoint id."""
    number: int
    """Grows from interface to interface: the order in which they were added."""
    spec: InterfaceSpec

    @property
    def id(self) -> str:
        """``user/tag/interface``."""
        return interface_key(self.endpoint, self.spec.tag)


def interface_key(endpoint: str, tag: str) -> str:
    """Return the key of an interface, which also names an end of connections."""
    return f"{endpoint}/{tag}"


class Connection(Struct, frozen=True, kw_only=True):
    """A connection of an interface of a link's endpoint ``a`` with one of its endpoint ``b``."""

    id: int
    """The channel number on the link."""
    link: str
    a: str
    """Endpoint id."""
    interface_a: str
    b: str
    interface_b: str

    @property
    def ends(self) -> tuple[str, str]:
        """The keys of the two interfaces."""
        return interface_key(self.a, self.interface_a), interface_key(self.b, self.interface_b)

    def interfaces_at(self, endpoint: str) -> tuple[str, ...]:
        """Return the tags of its interfaces at an endpoint: both, if the link has no other endpoint."""
        ends = ((self.a, self.interface_a), (self.b, self.interface_b))
        return tuple(tag for id_, tag in ends if id_ == endpoint)


class Link(Struct, frozen=True, kw_only=True):
    """What joins two endpoints of a user, or two interfaces of one; it is there while it has a connection."""

    id: str
    a: str
    """Endpoint id; never the greater one of the two."""
    b: str
    token: str

    def peer(self, endpoint: str) -> str:
        """Tell the other endpoint's id."""
        return self.b if endpoint == self.a else self.a


class ActiveInterface(Struct, frozen=True, kw_only=True):
    """An interface that is reported to have an established connection."""

    endpoint: str
    tag: str

    @property
    def id(self) -> str:
        """``user/tag/interface``."""
        return interface_key(self.endpoint, self.tag)


class OpenEnd(Struct, frozen=True, kw_only=True):
    """A connection that an endpoint reports as established."""

    endpoint: str
    connection: int

    @property
    def id(self) -> str:
        """Its key."""
        return open_end_key(self.endpoint, self.connection)


def open_end_key(endpoint: str, connection: int) -> str:
    """Return the key of an endpoint's end of a connection."""
    return f"{endpoint} {connection}"
