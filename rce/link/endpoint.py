"""A robot or a container: reconciles its interfaces, links and connections with its spec."""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import msgspec

from rce.aio.tasks import BackgroundTasks
from rce.control import (
    ConnectionSpec,
    DesiredState,
    Difference,
    EndpointKind,
    EndpointSpec,
    InterfaceUsage,
    SpecPatch,
)
from rce.guard import Holdings
from rce.link.channel import Channel
from rce.link.links import EndpointLinks, is_same_link
from rce.link.queues import Backlog
from rce.link.slot import InterfaceSlot
from rce.link.takeover import Takeovers
from rce.link.wiring import ChannelTable, Refusals, WiringNews

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable, Mapping

    from rce.link.hub import LinkHub
    from rce.link.interface import InterfaceFactory
    from rce.link.link import Link
    from rce.model import EndpointId, InterfaceSpec

_log = logging.getLogger(__name__)

T = TypeVar("T")

ADDED_AT_ONCE = 100
"""How many interfaces or connections are made before the event loop has its turn again."""


class Endpoint:
    """Interfaces, links and connections of one endpoint, as the newest applied spec says.

    Args:
        id: The endpoint.
        factory: Makes its interfaces.
        hub: Reaches its peers.
        on_change: Called when :attr:`interfaces` or :attr:`connections` changed; once for changes that come
            together.
        on_fault: Called with a text for the user when an interface cannot do its work.
        on_growth: Called when :attr:`waiting_bytes` grew.
    """

    def __init__(
        self,
        id: EndpointId,  # noqa: A002 - the word of the wire format
        factory: InterfaceFactory,
        hub: LinkHub,
        *,
        on_change: Callable[[], None],
        on_fault: Callable[[str], None],
        on_growth: Callable[[], None] = lambda: None,
    ) -> None:
        self.id = id
        self._factory = factory
        self._hub = hub
        self._on_change = on_change
        self._on_fault = on_fault
        self._slots: dict[str, InterfaceSlot] = {}
        self._channels = ChannelTable()
        self._desired = DesiredState(EndpointSpec(id=str(id), kind=EndpointKind.ROBOT, revision=-1))
        self._due = Difference()
        """The parts that may not be made yet."""
        self._news = WiringNews()
        self._backlog = Backlog(on_growth)
        self._holdings = Holdings(on_growth)
        self._refused = Refusals()
        self._starts: dict[InterfaceSlot, asyncio.Task[None]] = {}
        self._tasks = BackgroundTasks()
        self._links = EndpointLinks(id, hub, self._tasks, on_growth)
        self._takeovers = Takeovers(self._links, self._channels, self._backlog, self._tasks, hub.timeouts)
        self._lock = asyncio.Lock()
        self._notice: asyncio.Handle | None = None
        self._closed = False

    @property
    def interfaces(self) -> Mapping[str, bool]:
        """Interface tag to whether the interface has an established connection."""
        return {tag: slot.active for tag, slot in self._slots.items()}

    @property
    def connections(self) -> tuple[int, ...]:
        """Ids of the established connections, in order."""
        return self._channels.established

    def take_news(self) -> WiringNews:
        """Return the changes of interfaces and connections since the last call."""
        news, self._news = self._news, WiringNews()
        for tag in news.changed_interfaces:
            slot = self._slots.get(tag)
            if slot is None:
                news.removed_interfaces.append(tag)
            else:
                news.interfaces[tag] = slot.active
        for number in news.changed_connections:
            found = news.connections if self._channels.is_established(number) else news.lost_connections
            found.append(number)
        return news

    @property
    def desired_interfaces(self) -> frozenset[InterfaceSpec]:
        """The interfaces that were desired last."""
        return frozenset(self._desired.interfaces.values())

    def usage(self) -> dict[str, InterfaceUsage]:
        """Return the counters of every interface by tag, since it was made."""
        return {tag: slot.counters.usage() for tag, slot in self._slots.items()}

    @property
    def traffic(self) -> tuple[int, int]:
        """Bytes that came in and that went out on all sockets of its links, with headers."""
        return self._links.traffic

    @property
    def waiting_bytes(self) -> int:
        """Payload bytes that are held: to be sent, to be answered, incomplete, or latched."""
        return self._backlog.bytes + self._holdings.bytes + self._links.unfinished_bytes

    def shed(self, size: int) -> None:
        """Drop held payloads until ``size`` bytes are free, or nothing is left to drop.

        First the oldest messages of topics, where most waits; then the oldest requests and latched messages,
        also those that wait to be sent.
        """
        goal = self.waiting_bytes - size
        for channel in sorted(self._channels, key=lambda channel: -channel.waiting_bytes):
            if self.waiting_bytes <= goal:
                return
            channel.shed(self.waiting_bytes - goal)
        self._holdings.shed_until(lambda: self.waiting_bytes <= goal)

    def drop_unfinished(self, size: int) -> None:
        """Drop messages that have not come as a whole yet, until ``size`` bytes are free.

        The oldest go first, of the links on which most is incomplete.
        """
        goal = self.waiting_bytes - size
        for link in sorted(self._links, key=lambda link: -link.unfinished_bytes):
            if self.waiting_bytes > goal:
                link.drop_unfinished(self.waiting_bytes - goal)

    async def apply(self, spec: EndpointSpec) -> None:
        """Reconcile the actual state with ``spec``.

        Parts that are equal in both are not touched. Returns when the parts that are no longer desired are
        gone and the creation of new ones has begun: interfaces start and links are dialed in the background.
        An interface that cannot be made or started is reported to ``on_fault`` and does not affect the
        others; it is not tried again before its spec changes.

        Raises:
            RuntimeError: The endpoint is closed.
        """
        async with self._lock:
            if self._closed:
                raise RuntimeError(f"endpoint {self.id} is closed")
            self._due.include(self._desired.replace(spec))
            await self._reconcile()

    async def patch(self, patch: SpecPatch) -> None:
        """Do what :meth:`apply` does, with what changed since the spec or patch before.

        Raises:
            RuntimeError: The endpoint is closed.
        """
        async with self._lock:
            if self._closed:
                raise RuntimeError(f"endpoint {self.id} is closed")
            self._due.include(self._desired.patch(patch))
            await self._reconcile()

    async def close(self) -> None:
        """End everything; returns when nothing is left."""
        async with self._lock:
            self._closed = True
            self._drop_channels(list(self._channels))
            self._takeovers.close()
            carriers = self._links.drop(list(self._links))
            await self._close_slots(list(self._slots.values()))
            await self._tasks.close()
            for carrier in carriers:
                await carrier.wait_closed()
            self._links.limit(0)
            if self._notice is not None:
                self._notice.cancel()

    # What is due

    async def _reconcile(self) -> None:
        """Do what is due. If this is cancelled, it is due again the next time."""
        due, desired = self._due, self._desired
        if due.contents:
            self._links.limit(desired.contents.resources.bandwidth)
        self._refused.review(due.interfaces, due.connections, desired)
        slots = [
            slot
            for tag in due.interfaces
            if (slot := self._slots.get(tag)) is not None and desired.interfaces.get(tag) != slot.spec
        ]
        gone = [
            link
            for link_id in due.links
            if (link := self._links.get(link_id)) is not None
            and not is_same_link(link.spec, desired.links.get(link_id))
        ]
        for tag in due.interfaces:
            due.connections.update(dict.fromkeys(desired.connections_at(tag)))
        for link_id in due.links:
            due.connections.update(dict.fromkeys(desired.connections_on(link_id)))
        self._drop_channels(self._stale_channels(due, slots, gone))
        for link in gone:
            self._takeovers.forget(link.spec.id)
        self._links.drop(gone)
        await self._close_slots(slots)
        await self._add(due)
        self._due = Difference()

    # Taking away

    def _stale_channels(self, due: Difference, slots: list[InterfaceSlot], gone: list[Link]) -> list[Channel]:
        """Return the channels that are not desired any more, or whose interface or link ends."""
        stale: list[Channel] = []
        ended = {link.spec.id for link in gone}
        for number in due.connections:
            connection = self._desired.connections.get(number)
            ends = () if connection is None else self._ends(connection)
            stale += [
                channel
                for channel in self._channels.of(number)
                if channel.spec not in ends or channel.slot in slots or channel.spec.link in ended
            ]
        return stale

    def _drop_channels(self, channels: list[Channel]) -> None:
        for channel in channels:
            self._takeovers.channel_removed(channel)
            channel.link.remove(channel)
            channel.slot.remove(channel)
            self._channels.remove(channel)
            self._news.changed_connections[channel.number] = None

    async def _close_slots(self, slots: list[InterfaceSlot]) -> None:
        """Close interfaces, all at the same time; cancelling this does not stop the closing."""
        for slot in slots:
            del self._slots[slot.spec.tag]
            self._news.changed_interfaces[slot.spec.tag] = None
        if slots:
            self._changed()
            name = f"{self.id} closes an interface"
            await asyncio.wait([self._tasks.spawn(self._close_slot(slot), name=name) for slot in slots])

    async def _close_slot(self, slot: InterfaceSlot) -> None:
        start = self._starts.pop(slot, None)
        try:
            async with asyncio.timeout(self._hub.timeouts.close):
                if start is not None:
                    start.cancel()
                    await asyncio.wait([start])
                await slot.close()
        except TimeoutError:
            slot.fail(TimeoutError("takes too long to close"))
        except Exception as error:  # noqa: BLE001 - logged
            _log.debug("endpoint %s: interface %s did not close well", self.id, slot.spec.tag, exc_info=True)
            slot.fail(error)

    # Adding

    async def _add(self, due: Difference) -> None:
        desired = self._desired
        for link_id in due.links:
            if (link := desired.links.get(link_id)) is not None:
                self._links.put(link)
                self._takeovers.review(link_id)
        async for tag in _in_parts(due.interfaces):
            interface = desired.interfaces.get(tag)
            if interface is not None and tag not in self._slots and not self._refused.has_interface(tag):
                self._add_slot(interface)
        async for number in _in_parts(due.connections):
            connection = desired.connections.get(number)
            if connection is not None:
                self._add_channels(connection)

    def _add_channels(self, connection: ConnectionSpec) -> None:
        for end in self._ends(connection):
            if not self._channels.has(end) and not self._refused.has_connection(connection.id):
                self._add_channel(connection, end)

    def _add_slot(self, spec: InterfaceSpec) -> None:
        try:
            slot = InterfaceSlot(
                spec,
                limits=self._hub.limits,
                timeouts=self._hub.timeouts,
                on_change=partial(self._channel_changed, spec.tag),
                on_fault=self._on_fault,
                holdings=self._holdings,
            )
            slot.make(self._factory)
        except Exception as error:  # noqa: BLE001 - logged
            _log.debug("endpoint %s: interface %s cannot be made", self.id, spec.tag, exc_info=True)
            self._refused.add_interface(spec)
            self._on_fault(f"interface {spec.tag}: {error}")
            return
        self._slots[spec.tag] = slot
        self._news.changed_interfaces[spec.tag] = None
        self._starts[slot] = self._tasks.spawn(self._start(slot), name=f"{self.id} starts {spec.tag}")
        self._changed()

    async def _start(self, slot: InterfaceSlot) -> None:
        await slot.start()
        self._starts.pop(slot, None)

    def _ends(self, connection: ConnectionSpec) -> tuple[ConnectionSpec, ...]:
        """Return the ends of a connection that are here: both, if it joins interfaces of this endpoint."""
        link = self._desired.links.get(connection.link)
        if link is None or link.peer != str(self.id):
            return (connection,)
        there, here = connection.interface, connection.peer_interface
        return connection, msgspec.structs.replace(connection, interface=here, peer_interface=there)

    def _add_channel(self, connection: ConnectionSpec, end: ConnectionSpec) -> None:
        slot = self._slots.get(end.interface)
        link = self._links.get(end.link)
        if slot is None or link is None:
            missing = f"interface {end.interface}" if slot is None else f"link {end.link}"
            self._refused.add_connection(connection)
            self._on_fault(f"connection {end.id}: there is no {missing}")
            return
        if end is not connection:
            link = self._links.far_end(end.link)
        channel = Channel(end, slot, link, self._backlog)
        self._channels.add(channel)
        slot.add(channel)
        link.add(channel)
        self._takeovers.channel_added(channel)

    def _channel_changed(self, tag: str, number: int) -> None:
        """Take note that a channel of an interface was established or lost."""
        self._news.changed_interfaces[tag] = None
        self._news.changed_connections[number] = None
        self._changed()

    def _changed(self) -> None:
        """Call ``on_change`` soon, once for all changes until then."""
        if self._notice is None and not self._closed:
            self._notice = asyncio.get_running_loop().call_soon(self._tell)

    def _tell(self) -> None:
        self._notice = None
        self._on_change()


async def _in_parts(items: Iterable[T]) -> AsyncIterator[T]:
    """Iterate, and let others have their turn in between: an endpoint may have thousands of parts."""
    for count, item in enumerate(items, 1):
        if count % ADDED_AT_ONCE == 0:
            await asyncio.sleep(0)
        yield item
