"""The links of one endpoint: dials them, keeps them up, and limits what passes on them."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.link.carrier import Carrier, LocalCarrier
from rce.link.exceptions import LinkError
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
        self._dials: dict[Link, asyncio.Task[None]] = {}
        self._pacer: Pacer | None = None
        self._former_traffic = (0, 0)

    def __iter__(self) -> Iterator[Link]:
        return iter(self._links.values())

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
            link = self._links[spec.id] = Link(spec, self._hub.limits, self._on_growth)
            link.pace(self._pacer)
            if spec.peer == str(self._id):
                self._far_ends[spec.id] = _loop_back(link)
            elif spec.dial:
                self._dial(link)
            else:
                self._hub.register(link)
        elif link.spec != spec:
            redial = spec.dial and _must_redial(link, spec.address)
            link.spec = spec
            if redial:
                self._stop_dialing(link)
                link.detach()
                self._dial(link)

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

    def _dial(self, link: Link) -> None:
        task = self._tasks.spawn(_keep_dialed(link, self._hub), name=f"{self._id} dials {link.spec.peer}")
        self._dials[link] = task

    def _stop_dialing(self, link: Link) -> None:
        task = self._dials.pop(link, None)
        if task is not None:
            task.cancel()


async def _keep_dialed(link: Link, hub: LinkHub) -> None:
    """Dial a link, again whenever its carrier ended. Ends by cancellation only."""
    pauses = hub.timeouts.redial.start()
    while True:
        if not hub.can_reach(link.spec):
            await hub.wait_registered(link.spec.id, None)
        since = hub.loop.time()
        try:
            carrier = await hub.connect(link.spec)
        except (OSError, LinkError) as error:
            _log.debug("link %s to %s: %s", link.spec.id, link.spec.peer, error)
        else:
            link.attach(carrier)
            await carrier.wait_closed()
        if hub.loop.time() - since > _LONG_ENOUGH:
            pauses.reset()
        await hub.wait_registered(link.spec.id, pauses.next())


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
