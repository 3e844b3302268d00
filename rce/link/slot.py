"""The place of one interface in its endpoint: its port, channels and counters."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rce.guard import Holdings
from rce.link.calls import CallServer
from rce.link.channel import Channel, as_payload
from rce.link.exceptions import MessageTooLargeError, NotConnectedError
from rce.link.latch import HeardSources, LatchedMessages
from rce.link.queues import Counters
from rce.model import InterfaceSpec, InterfaceType, Role

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from rce.link.interface import Buffer, Interface, InterfaceFactory
    from rce.link.settings import LinkLimits, LinkTimeouts

_log = logging.getLogger(__name__)


class InterfaceSlot:
    """Holds one interface and is its :class:`~rce.link.interface.Port`.

    Attributes:
        role: What the interface does.
        started: Whether it can be used.
        active: Whether it has an established connection.
        counters: Its traffic.
        server: Serves the peers' requests; service clients only.
    """

    def __init__(
        self,
        spec: InterfaceSpec,
        *,
        limits: LinkLimits,
        timeouts: LinkTimeouts,
        on_change: Callable[[int], None],
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
        self._others: dict[Channel, None] = {}
        """Channels to copies of peers and to former places of peers: nothing is sent on them."""
        self._holdings = Holdings() if holdings is None else holdings
        self._latched = LatchedMessages(self._holdings, self._latched_given_up, self._source_ended)
        self._heard = HeardSources()
        self._faults: set[str] = set()

    # Port

    @property
    def spec(self) -> InterfaceSpec:
        """The interface's spec."""
        return self._spec

    def send(self, payload: Buffer, *, latched: bool = False, source: str = "") -> None:
        """Send a message to every peer."""
        if self.role is not Role.SUBSCRIBER:
            raise TypeError(f"{self._spec.tag} is a {self._spec.type}: only a subscriber sends messages")
        try:
            data = as_payload(payload, self._limits.max_message)
        except MessageTooLargeError as error:
            self.counters.dropped += 1
            self._fault_once(str(error))
            return
        number = self._latched.keep(source, data) if latched else 0
        for channel in self._channels.values():
            if latched and source not in self._latched:
                return  # memory is short: it was thrown away, which was told
            channel.send(data, source=number)

    def keep_latched(self, sources: Collection[str]) -> None:
        """Take back the latched messages of all sources but these."""
        if self._latched.retain(sources):
            self._send_sources()

    async def call(self, payload: Buffer, *, timeout: float | None = None) -> bytes:
        """Ask the peer."""
        if self.role is not Role.SERVICE_PROVIDER:
            raise TypeError(f"{self._spec.tag} is a {self._spec.type}: only a service provider calls")
        data = as_payload(payload, self._limits.max_message)
        for channel in self._channels.values():
            if channel.established:
                return await channel.call(data, self._timeouts.call if timeout is None else timeout)
        raise NotConnectedError

    # The life of the interface

    def make(self, factory: InterfaceFactory) -> None:
        """Make the interface. Exceptions of the factory are passed on."""
        self._interface = interface = factory(self)
        if self.role is Role.SERVICE_CLIENT:
            self.server = CallServer(interface.serve, self._limits, self._spec.tag, self._holdings)

    async def start(self) -> None:
        """Start the interface and open its channels; a failure is reported."""
        assert self._interface is not None
        try:
            await self._interface.start()
        except Exception as error:  # noqa: BLE001 - logged
            _log.debug("interface %s did not start", self._spec.tag, exc_info=True)
            self._fault(str(error) or type(error).__name__)
            return
        self.started = True
        for channel in [*self._channels.values(), *self._others]:
            channel.open()

    async def close(self) -> None:
        """End the interface; its channels were removed before."""
        self._latched.retain(())
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
        """Remove a connection; it was closed before."""
        del self._channels[channel.number]
        self._unlatch(self._heard.retain(channel.number))

    @property
    def others(self) -> tuple[Channel, ...]:
        """The channels to copies of peers, and to former places of peers."""
        return tuple(self._others)

    def add_other(self, channel: Channel) -> None:
        """Take a channel in on which nothing is sent."""
        self._others[channel] = None

    def remove_other(self, channel: Channel) -> None:
        """Remove such a channel."""
        self._others.pop(channel, None)

    def replace(self, former: Channel, channel: Channel) -> None:
        """Send on another channel of the same connection from now on; what comes on both is taken."""
        self.remove_other(channel)
        self._channels[channel.number] = channel
        self.add_other(former)
        self.channel_changed(channel)

    def send_latched(self, channel: Channel) -> None:
        """Send what is latched on a channel."""
        if channel.established and self.role is Role.SUBSCRIBER:
            for kept in self._latched:
                channel.send(kept.payload, source=kept.number)
            channel.send_sources(self._latched.numbers)

    def channel_changed(self, channel: Channel) -> None:
        """Take note that a channel was established or lost."""
        if not channel.established and self.server is not None:
            self.server.cancel(channel)
        if channel in self._others:
            return
        self.send_latched(channel)
        active = any(channel.established for channel in self._channels.values())
        if active != self.active:
            self.active = active
            self._tell_interface(active)
        self._on_change(channel.number)

    def receive(self, channel: Channel, payload: bytes, source: int | None) -> None:
        """Hand a peer's message to the interface; a latched one has a source."""
        self.counters.count_in(len(payload))
        assert self._interface is not None
        try:
            if source is None or channel in self._others:
                self._interface.receive(payload, latched=False)
            else:
                name, ended = self._heard.note_source(channel.number, source)
                self._unlatch(ended)
                self._interface.receive_latched(payload, name)
        except Exception as error:  # noqa: BLE001 - logged
            _log.debug("interface %s refused a message", self._spec.tag, exc_info=True)
            self._fault_once(str(error) or type(error).__name__)

    def message_dropped(self, channel: Channel, source: int | None) -> None:
        """Take note that a peer's message was dropped on arrival: what its source latched is outdated."""
        self.counters.dropped += 1
        self._fault_once("memory is short; a message was dropped while it came in")
        if source is not None:
            name, ended = self._heard.note_source(channel.number, source)
            self._unlatch([*ended, name])

    def keep_sources(self, channel: Channel, sources: Collection[int]) -> None:
        """Have the interface forget what other sources of the peer latched."""
        if channel in self._others:
            return
        self._unlatch(self._heard.retain(channel.number, sources))

    def _unlatch(self, sources: list[str]) -> None:
        if sources and self._interface is not None:
            try:
                self._interface.unlatch(sources)
            except Exception as error:  # noqa: BLE001 - logged
                _log.debug("interface %s: unlatch failed", self._spec.tag, exc_info=True)
                self._fault_once(str(error) or type(error).__name__)

    def _send_sources(self) -> None:
        for channel in self._channels.values():
            channel.send_sources(self._latched.numbers)

    def _source_ended(self, number: int) -> None:
        for channel in [*self._channels.values(), *self._others]:
            channel.release_latched(number)

    def _latched_given_up(self, number: int) -> None:
        for channel in [*self._channels.values(), *self._others]:
            channel.withdraw_latched(number)  # it refers to the same bytes
        self.counters.dropped += 1
        self._fault_once("memory is short; its latched message was dropped")
        self._send_sources()

    def _tell_interface(self, active: bool) -> None:
        assert self._interface is not None
        try:
            self._interface.on_active(active)
        except Exception as error:  # noqa: BLE001 - logged
            _log.debug("interface %s: on_active failed", self._spec.tag, exc_info=True)
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
