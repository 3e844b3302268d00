"""The links of one endpoint: dials them, keeps them up, and limits what passes on them."""

from __future__ import annotations

import logging
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.link.carrier import Carrier, LocalCarrier
from rce.link.exceptions import LinkError
from rce.link.handshake import TAKEOVER
from rce.link.link import Link, add_traffic
from rce.link.pacing import Pacer

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Iterator

    from rce.aio.tasks import BackgroundTasks
    from rce.control import LinkAddress, LinkSpec
    from rce.link.hub import LinkHub
    from rce.model import EndpointId

_log = logging.getLogger(__name__)

_LONG_ENOUGH = 1.0
"""After a connection that lasted so many seconds, the next pause is short again."""


class EndpointLinks:
    """The links of one endpoint, by id.

    Args:
        id: The endpoint.
        hub: Reaches its peers.
        tasks: Owns the tasks that dial.
        on_growth: Called when more bytes wait on a link.
    """

    def __init__(
        self,
        id: EndpointId,  # noqa: A002 - the word of the wire format
        hub: LinkHub,
        tasks: BackgroundTasks,
        on_growth: Callable[[], None],
    ) -> None:
        self._id = id
        self._hub = hub
        self._tasks = tasks
        self._on_growth = on_growth
        self._links: dict[str, Link] = {}
        self._far_ends: dict[str, Link] = {}
        """The other ends of links of this endpoint with itself."""
        self._others: dict[Link, None] = {}
        """Links to copies of peers, and to former places of peers."""
        self.is_awaited: Callable[[Link], bool] = lambda _: False
        """Whether the link to the peer's copy, which has the address now, will take the place of a link."""
        self.take_over: Callable[[str], None] = lambda _: None
        """Let it take the place now."""
        self.on_successor: Callable[[Link, Carrier], None] | None = None
        """Takes a connection that a peer's copy dialed."""
        self._dials: dict[Link, asyncio.Task[None]] = {}
        self._pacer: Pacer | None = None
        self._former_traffic = (0, 0)

    def __iter__(self) -> Iterator[Link]:
        return chain(self._links.values(), self._others)

    def __getitem__(self, link_id: str) -> Link:
        return self._links[link_id]

    def get(self, link_id: str) -> Link | None:
        """Return a link, or None."""
        return self._links.get(link_id)

    def far_end(self, link_id: str) -> Link:
        """Return the other end of a link of this endpoint with itself."""
        return self._far_ends[link_id]

    @property
    def traffic(self) -> tuple[int, int]:
        """Bytes that came in and that went out on all sockets of the links, with headers."""
        total = self._former_traffic
        for link in self:
            total = add_traffic(total, link.traffic)
        return total

    @property
    def unfinished_bytes(self) -> int:
        """Payload bytes of messages that have not come as a whole yet."""
        return sum(link.unfinished_bytes for link in self)

    def limit(self, rate: int) -> None:
        """Let ``rate`` bytes per second pass on all links together; 0 for any number."""
        if rate and self._pacer is not None:
            self._pacer.change(rate)
        elif rate or self._pacer is not None:
            former, self._pacer = self._pacer, Pacer(rate) if rate else None
            for link in self:
                link.pace(self._pacer)
            if former is not None:
                former.close()

    def put(self, spec: LinkSpec) -> None:
        """Make a link, or give the present one its new spec."""
        link = self._links.get(spec.id)
        if link is None:
            link = self._links[spec.id] = self.make(spec)
            if spec.peer == str(self._id):
                self._far_ends[spec.id] = _loop_back(link)
            elif spec.dial:
                self.dial(link)
            else:
                self._hub.register(link)
        elif link.spec != spec:
            redial = spec.dial and _must_redial(link, spec.address)
            link.change(spec)
            if (far := self._far_ends.get(spec.id)) is not None:
                far.change(spec)
            if redial and not self.is_awaited(link):
                self._stop_dialing(link)
                link.detach()
                self.dial(link)

    def make(self, spec: LinkSpec) -> Link:
        """Make a link, without adding it."""
        link = Link(spec, self._hub.limits, self._on_growth)
        link.pace(self._pacer)
        if self.on_successor is not None:
            link.on_successor = partial(self.on_successor, link)
        return link

    def include(self, link: Link) -> None:
        """Add a link that stands beside another one."""
        self._others[link] = None

    def exclude(self, link: Link) -> None:
        """End a link that stood beside another one."""
        self._stop_dialing(link)
        link.detach()
        del self._others[link]
        self._former_traffic = add_traffic(self._former_traffic, link.traffic)

    def exchange(self, former: Link, link: Link) -> None:
        """Let two links that stand beside each other change places."""
        self._stop_dialing(former)
        self._hub.unregister(former)
        self._others[former] = None
        del self._others[link]
        self._links[link.spec.id] = link
        if not link.spec.dial:
            self._hub.register(link)
        elif self._dials[link].done():  # a copy of an earlier release cannot stand by: it is dialed now
            self.dial(link)

    def drop(self, links: list[Link]) -> list[Carrier]:
        """Forget links; return the carriers that are still closing."""
        for link in links:
            self._hub.unregister(link)
            self._stop_dialing(link)
            del self._links[link.spec.id]
        far_ends = (self._far_ends.pop(link.spec.id, None) for link in links)
        ended = [*links, *filter(None, far_ends)]
        carriers = [carrier for link in ended if (carrier := link.detach()) is not None]
        for link in ended:
            self._former_traffic = add_traffic(self._former_traffic, link.traffic)
        return carriers

    def dial(self, link: Link) -> None:
        """Dial a link, and again whenever its connection ends."""
        name = f"{self._id} dials {link.spec.peer}"
        self._dials[link] = self._tasks.spawn(self._keep_dialed(link), name=name)

    async def _keep_dialed(self, link: Link) -> None:
        """Dial a link, again whenever its carrier ended, until another one is to take its place."""
        hub = self._hub
        pauses = hub.timeouts.redial.start()
        while True:
            if not hub.can_reach(link.spec):
                await hub.wait_registered(link.spec.id, None)
            since = hub.loop.time()
            try:
                carrier = await hub.connect(link.spec, standby=link.is_standby)
            except (OSError, LinkError) as error:
                _log.debug("link %s to %s: %s", link.spec.id, link.spec.peer, error)
            else:
                if link.is_standby and TAKEOVER not in carrier.features:
                    carrier.close()
                    return
                link.attach(carrier)
                await carrier.wait_closed()
                if link.was_left:
                    return
                if self.is_awaited(link):
                    self.take_over(link.spec.id)
                    return
            if hub.loop.time() - since > _LONG_ENOUGH:
                pauses.reset()
            await hub.wait_registered(link.spec.id, pauses.next())

    def _stop_dialing(self, link: Link) -> None:
        task = self._dials.pop(link, None)
        if task is not None:
            task.cancel()


def _must_redial(link: Link, address: LinkAddress) -> bool:
    """Return whether a link must be dialed at a new address now.

    A connection by TCP continues when only the path of the peer's unix socket changed: a process that
    ended took its connections with it, so this one was made with its successor, before the path was known.
    """
    former, carrier = link.spec.address, link.carrier
    if former == address or (carrier is not None and carrier.kind == "local"):
        return False
    return carrier is None or carrier.kind != "tcp" or replace(former, unix=address.unix) != address


def _loop_back(link: Link) -> Link:
    """Make the other end of the link of an endpoint with itself, and join the two for good."""
    far = Link(link.spec, link.limits)
    one, other = LocalCarrier.pair()
    link.attach(one)
    far.attach(other)
    return far


def is_same_link(old: LinkSpec, new: LinkSpec | None) -> bool:
    """Return whether a link can continue under a new spec: another address or token does not end it."""
    return new is not None and (old.peer, old.dial) == (new.peer, new.dial)
