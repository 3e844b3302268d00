"""The interfaces of a program by their tags, and what came for those that it has not made yet. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.protocol import NO_ID, CallId, DataMessage, ErrorReport
from rce_client.early_messages import EarlyMessages
from rce_client.exceptions import InterfaceError
from rce_client.services import ServiceClient

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_client.interfaces import ClientInterface


class InterfaceTable:
    """Gives each interface what comes for it.

    The engine gives a robot that returns the latched messages of its interfaces at once, also if another
    program, or an earlier run of this one, made them. The last message of each topic and source is kept until
    the program makes the interface, unless it removed it before.
    """

    def __init__(self) -> None:
        self.active: dict[str, bool] = {}
        """Own interface tags to whether they are joined with a peer."""
        self._interfaces: dict[str, ClientInterface] = {}
        self._early = EarlyMessages()
        self._withdrawn: set[str] = set()
        """Tags of own interfaces that were removed; what still comes for them is dropped."""

    def add(self, interface: ClientInterface) -> None:
        """Add an interface, and give it what came before.

        Raises:
            InterfaceError: There is one with its tag; the new one is closed.
        """
        if interface.tag in self._interfaces:
            interface.on_closed()
            raise InterfaceError(f"interface {interface.tag} is there already: close it before another one")
        self._interfaces[interface.tag] = interface
        for early in self._early.take(interface.tag):
            if interface.fits(early):
                interface.deliver(early)

    def remove(self, interface: ClientInterface) -> bool:
        """Close an interface and forget it; return whether it was there."""
        if self._interfaces.get(interface.tag) is not interface:
            return False
        del self._interfaces[interface.tag]
        interface.on_closed()
        return True

    def withdraw(self, interface: ClientInterface) -> bool:
        """Remove an interface with all that still comes for it; return whether it was there."""
        if not self.remove(interface):
            return False
        self._withdrawn.add(interface.tag)
        self.active.pop(interface.tag, None)
        return True

    def close(self) -> None:
        """Close all interfaces: no more messages will come."""
        for interface in self._interfaces.values():
            interface.on_closed()

    # What comes from the engine

    def deliver(self, message: DataMessage) -> None:
        """Give a message to its interface, or keep it until that is made."""
        interface = self._interfaces.get(message.i_tag)
        if interface is not None:
            # What was on its way to a removed interface must not reach a later one of another type.
            if message.i_tag not in self._withdrawn or message.msg_id != NO_ID or interface.fits(message):
                interface.deliver(message)
        elif message.msg_id == NO_ID and message.i_tag not in self._withdrawn:
            self._early.keep(message)

    def set_active(self, tag: str, active: bool) -> None:
        """Note whether an interface is joined with a peer."""
        self.active[tag] = active
        interface = self._interfaces.get(tag)
        if interface is not None:
            (interface.on_active if active else interface.on_inactive)()

    def keep_latched(self, tag: str, sources: Sequence[str]) -> None:
        """Tell an interface which sources are still there."""
        if tag in self._interfaces:
            self._interfaces[tag].keep_latched(sources)

    def fail(self, tag: str, msg_id: str, text: str) -> bool:
        """Tell an interface of a fault of one message; return whether it is a service client."""
        interface = self._interfaces.get(tag)
        if interface is not None:
            interface.on_fault(msg_id, text)
        return isinstance(interface, ServiceClient)

    def call_of(self, report: ErrorReport) -> CallId | None:
        """Return the service call of this program that an ``ER`` is about."""
        if report.call is not None:
            return report.call if isinstance(self._interfaces.get(report.call.i_tag), ServiceClient) else None
        clients = [one for one in self._interfaces.values() if isinstance(one, ServiceClient)]
        return next((call for one in clients if (call := one.call_of(report.text)) is not None), None)

    def lose(self) -> None:
        """Learn that the connection ended: as far as is known here, no interface is joined any more."""
        self.active = dict.fromkeys(self.active, False)
        self._early.clear()
        for interface in list(self._interfaces.values()):
            interface.on_lost()
