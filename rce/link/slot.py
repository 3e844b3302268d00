"""The place of one interface in its endpoint: its port, channels and counters."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rce.guard.holdings import Holdings
from rce.link.calls import CallServer
from rce.link.channel import as_payload
from rce.link.exceptions import MessageTooLarge, NotConnected
from rce.link.queues import Counters
from rce.protocol.names import InterfaceType, Role

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.control.model import InterfaceSpec
    from rce.guard.holdings import Holding
    from rce.link.channel import Channel
    from rce.link.interface import Buffer, Interface, InterfaceFactory
    from rce.link.settings import LinkLimits, LinkTimeouts

log = logging.getLogger(__name__)


class InterfaceSlot:
    """Holds one interface and is its :class:`~rce.link.interface.Port`.

    Attributes:
        role: What the interface does.
        started: Whether it can be used.
        active: Whether it has an established connection.
        counters: What it moved.
        server: Serves the peers' requests; service clients only.
    """

    def __init__(
        self,
        spec: InterfaceSpec,
        *,
        limits: LinkLimits,
        timeouts: LinkTimeouts,
        on_change: Callable[[], None],
        on_fault: Callable[[str], None],
        holdings: Holdings | None = None,
    ) -> None:
        self.role = InterfaceType.parse(spec.type).role
        self.started = False
        self.active = False
        self.counters = Counters()
        self.server: CallServer | None = None
        self._spec = spec
        self._limits = limits
        self._timeouts = timeouts
        self._on_change = on_change
        self._on_fault = on_fault
        self._interface: Interface | None = None
        self._channels: dict[int, Channel] = {}
        self._latched: bytes | memoryview | None = None
        self._holdings = Holdings() if holdings is None else holdings
        self._latched_holding: Holding | None = None
        self._faults: set[str] = set()

    # Port

    @property
    def spec(self) -> InterfaceSpec:
        """What the interface was made for."""
        return self._spec

    def send(self, payload: Buffer, *, latched: bool = False) -> None:
        """Send a message to every peer."""
        if self.role is not Role.SUBSCRIBER:
            raise TypeError(f"{self._spec.tag} is a {self._spec.type}: only a subscriber sends messages")
        try:
            data = as_payload(payload, self._limits.max_message)
        except MessageTooLarge as error:
            self.counters.dropped += 1
            self._fault_once(str(error))
            return
        if latched:
            self._keep(data)
        for channel in self._channels.values():
            channel.send(data, latched=latched)

    async def call(self, payload: Buffer, *, timeout: float | None = None) -> bytes:
        """Ask the peer."""
        if self.role is not Role.SERVICE_PROVIDER:
            raise TypeError(f"{self._spec.tag} is a {self._spec.type}: only a service provider calls")
        data = as_payload(payload, self._limits.max_message)
        for channel in self._channels.values():
            if channel.established:
                return await channel.call(data, self._timeouts.call if timeout is None else timeout)
        raise NotConnected

    # The life of the interface

    def make(self, factory: InterfaceFactory) -> None:
        """Make the interface. Raises whatever the factory raises."""
        self._interface = interface = factory(self)
        if self.role is Role.SERVICE_CLIENT:
            self.server = CallServer(interface.serve, self._limits, self._spec.tag, self._holdings)

    async def start(self) -> None:
        """Start the interface and open its channels; a failure is reported."""
        assert self._interface is not None
        try:
            await self._interface.start()
        except Exception as error:
            log.debug("interface %s did not start", self._spec.tag, exc_info=True)
            self._fault(str(error) or type(error).__name__)
            return
        self.started = True
        for channel in list(self._channels.values()):
            channel.open()

    async def close(self) -> None:
        """End the interface; its channels were removed before."""
        self._forget_latched()
        if self.server is not None:
            await self.server.close()
        if self._interface is not None:
            await self._interface.close()

    def fail(self, error: Exception) -> None:
        """Report what went wrong with the interface."""
        self._fault(str(error) or type(error).__name__)

    # Channels

    def add(self, channel: Channel) -> None:
        """Take a connection in."""
        self._channels[channel.number] = channel

    def remove(self, channel: Channel) -> None:
        """Let a connection go; it was closed before."""
        del self._channels[channel.number]

    def channel_changed(self, channel: Channel) -> None:
        """Take note that a channel was established or lost."""
        if channel.established and self._latched is not None:
            channel.send(self._latched, latched=True)
        if not channel.established and self.server is not None:
            self.server.cancel(channel)
        active = any(channel.established for channel in self._channels.values())
        if active != self.active:
            self.active = active
            self._tell_interface(active)
        self._on_change()

    def receive(self, payload: bytes, *, latched: bool) -> None:
        """Hand a peer's message to the interface."""
        self.counters.count_in(len(payload))
        assert self._interface is not None
        try:
            self._interface.receive(payload, latched=latched)
        except Exception as error:
            log.debug("interface %s refused a message", self._spec.tag, exc_info=True)
            self._fault_once(str(error) or type(error).__name__)

    def _keep(self, data: bytes | memoryview) -> None:
        """Keep a latched message in place of the one before."""
        self._forget_latched()
        self._latched = data
        self._latched_holding = self._holdings.hold(len(data), self._give_up_latched)

    def _forget_latched(self) -> None:
        self._latched = None
        if self._latched_holding is not None:
            self._latched_holding.release()
            self._latched_holding = None

    def _give_up_latched(self) -> None:
        self._latched = self._latched_holding = None
        self.counters.dropped += 1
        self._fault_once("memory is short; its latched message was dropped")

    def _tell_interface(self, active: bool) -> None:
        assert self._interface is not None
        try:
            self._interface.on_active(active)
        except Exception as error:
            log.debug("interface %s: on_active failed", self._spec.tag, exc_info=True)
            self._fault_once(str(error) or type(error).__name__)

    def _fault_once(self, text: str) -> None:
        """Report what may go wrong with every message only the first time."""
        if text not in self._faults and len(self._faults) < _MAX_FAULTS:
            self._faults.add(text)
            self._fault(text)

    def _fault(self, text: str) -> None:
        self._on_fault(f"interface {self._spec.tag}: {text}")


_MAX_FAULTS = 16
"""Different faults of one interface's messages that are reported."""
