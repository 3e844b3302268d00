"""Counts connections that have not authenticated yet, for each address and in all (sans-I/O).

Authenticated connections are not counted, so many robots may share the address of a proxy. Of the others, the
*silent* ones (which have sent nothing useful yet) are closed first: the handshake of a real client takes one
round trip, while a connection that is held open on purpose stays. So a client that fills the lobby causes
its own connections to be closed.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

PER_ADDRESS = 256
IN_ALL = 1024

_log = logging.getLogger(__name__)
_V6_SITE = 64
"""Bits of an IPv6 address that identify a site; the site chooses the rest."""


class Guest:
    """A connection in a lobby. Its methods may be called in any order, any number of times."""

    __slots__ = ("_lobby", "address", "turn_out")

    def __init__(self, lobby: Lobby, address: str, turn_out: Callable[[], object]) -> None:
        self._lobby = lobby
        self.address = address
        self.turn_out = turn_out

    def speak(self) -> None:
        """Take note that it began a valid handshake: it stays until it leaves."""
        self._lobby._silent_at(self.address).pop(self, None)  # noqa: SLF001 - same module

    def rest(self) -> None:
        """Take :meth:`speak` back: it is idle, and may be asked to make room."""
        self._lobby._rest(self)  # noqa: SLF001 - same module

    def leave(self) -> None:
        """Take note that it is known now, or gone."""
        self._lobby._leave(self)  # noqa: SLF001 - same module


class Lobby:
    """The connections of one kind that have not authenticated yet.

    Args:
        name: The kind of connections, for the log.
        per_address: Most from one address (for IPv6: one network of 64 bits).
        in_all: Most from everywhere.

    Attributes:
        name: What comes in here.
        turned_away: How many were refused, or closed to make room for others.
    """

    def __init__(self, name: str, *, per_address: int = PER_ADDRESS, in_all: int = IN_ALL) -> None:
        self.name = name
        self._per_address = per_address
        self._in_all = in_all
        self._guests: dict[str, dict[Guest, None]] = {}
        self._silent: dict[str, dict[Guest, None]] = {}
        """Those of them that are silent, oldest first."""
        self._count = 0
        self._complained: set[str] = set()
        """Addresses that were logged, for as long as they have a guest."""
        self.turned_away = 0

    def __len__(self) -> int:
        return self._count

    def enter(self, address: str, turn_out: Callable[[], object]) -> Guest | None:
        """Add a connection; return None if it must be closed at once.

        Args:
            address: As :func:`address_of` says it.
            turn_out: Ends the connection; it is called if others need its place.
        """
        if len(self._guests.get(address, ())) >= self._per_address and not self._turn_out_one(address):
            self._complain(address)
            return None
        if self._count >= self._in_all:
            crowd = max(self._guests, key=lambda address: len(self._guests[address]))
            if not self._turn_out_one(crowd):
                self._complain(crowd)
                return None
        guest = Guest(self, address, turn_out)
        self._guests.setdefault(address, {})[guest] = None
        self._silent.setdefault(address, {})[guest] = None
        self._count += 1
        return guest

    def _turn_out_one(self, address: str) -> bool:
        guest = next(iter(self._silent_at(address)), None)
        if guest is None:
            return False
        self._complain(address)
        guest.leave()
        guest.turn_out()
        return True

    def _complain(self, address: str) -> None:
        self.turned_away += 1
        if address not in self._complained and address in self._guests:
            self._complained.add(address)
            count = len(self._guests[address])
            _log.warning("%s: %d connections from %s do not say who they are", self.name, count, address)

    def _silent_at(self, address: str) -> dict[Guest, None]:
        return self._silent.get(address, {})

    def _rest(self, guest: Guest) -> None:
        if guest in self._guests.get(guest.address, {}):
            self._silent[guest.address][guest] = None

    def _leave(self, guest: Guest) -> None:
        guests = self._guests.get(guest.address, {})
        if guest in guests:
            self._count -= 1
            del guests[guest]
            self._silent[guest.address].pop(guest, None)
            if not guests:
                del self._guests[guest.address], self._silent[guest.address]
                self._complained.discard(guest.address)


def address_of(peer: object) -> str:
    """Return the address that a peer counts for: its IPv4 address or IPv6 network; empty for unix sockets.

    Args:
        peer: As :meth:`socket.socket.getpeername` says it.
    """
    import ipaddress  # takes milliseconds, which containers that start have no use for

    if not isinstance(peer, tuple) or not peer:
        return ""
    try:
        address = ipaddress.ip_address(str(peer[0]).partition("%")[0])
    except ValueError:
        return str(peer[0])
    if address.version == 4:  # noqa: PLR2004 - the protocol's number
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((address, _V6_SITE), strict=False))
