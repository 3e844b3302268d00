"""Second connections of links: to the copy of a peer that is being moved, and to its former place.

A peer that is moved exists twice for a while. A link is made before it is broken::

    present link ----- OPEN ------------------ last answers ---- ended, when it is quiet
    link to the copy          dialed, OPEN ... | TAKE: the present link from here on
                                               | LEAVE, on the other one

- The dialing end dials the copy too (:attr:`~rce.control.model.LinkSpec.next`), or the copy dials; HELLO says
  so. Both ends open the channels, so that the copy reports them as established; it sends nothing.
- When the copy becomes the endpoint, it says TAKE on all its links at once, before anything else. From there
  on this end sends to it, and takes what it sends.
- What waited for the former place is still sent there, and what comes from there is still taken: calls are
  answered by the place that got them. The former link ends when no call is under way on it and nothing came
  for a while (:class:`~rce.link.settings.LinkTimeouts`).
"""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.link.channel import Channel

if TYPE_CHECKING:
    from rce.aio.tasks import BackgroundTasks
    from rce.control import LinkSpec
    from rce.link.carrier import Carrier
    from rce.link.link import Link
    from rce.link.links import EndpointLinks
    from rce.link.queues import Backlog
    from rce.link.settings import LinkTimeouts
    from rce.link.wiring import ChannelTable

_log = logging.getLogger(__name__)

_LOOK = 0.05
"""Seconds between two looks at whether a former link is quiet."""


class Takeovers:
    """The links of one endpoint that stand beside others.

    Invariant: a link to a copy has a channel for each channel of the link that it stands beside.

    Args:
        links: All links of the endpoint.
        channels: Its channels, without those of links that stand beside others.
        backlog: Counts what waits.
        tasks: Owns the tasks that wait for the end of former links.
        timeouts: Of links.
    """

    def __init__(
        self,
        links: EndpointLinks,
        channels: ChannelTable,
        backlog: Backlog,
        tasks: BackgroundTasks,
        timeouts: LinkTimeouts,
    ) -> None:
        self._links = links
        self._channels = channels
        self._backlog = backlog
        self._tasks = tasks
        self._timeouts = timeouts
        self._copies: dict[str, Link] = {}
        """By the link's id, as timers."""
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._former: dict[Link, asyncio.Task[None]] = {}
        links.is_awaited = self._is_awaited
        links.take_over = self._take_over
        links.on_successor = self._copy_dialed

    def review(self, link_id: str) -> None:
        """Do what follows from a link's new spec."""
        link = self._links[link_id]
        spec, copy = link.spec, self._copies.get(link_id)
        if not spec.dial:
            return
        if spec.next is not None:
            if copy is None or copy.spec.address != spec.next:
                self._give_up(link_id)
                self._links.dial(self._stand_by(link, replace(spec, address=spec.next, next=None)))
        elif copy is not None:
            if copy.spec.address != spec.address:
                self._give_up(link_id)
            elif link.carrier is None:
                self._take_over(link_id)
            elif link_id not in self._timers:
                later = asyncio.get_running_loop().call_later
                self._timers[link_id] = later(self._timeouts.take, self._take_over, link_id)

    def channel_added(self, channel: Channel) -> None:
        """Add a channel beside a new one."""
        copy = self._copies.get(channel.spec.link)
        if copy is not None:
            self._add_twin(channel, copy)

    def channel_removed(self, channel: Channel) -> None:
        """Remove the channels beside one that is removed."""
        for other in channel.slot.others:
            if other.number == channel.number:
                other.slot.remove_other(other)
                other.link.remove(other)

    def forget(self, link_id: str) -> None:
        """End everything that stands beside a link."""
        self._give_up(link_id)
        for former in [link for link in self._former if link.spec.id == link_id]:
            self._former.pop(former).cancel()
            self._end(former)

    def close(self) -> None:
        """End everything."""
        for link_id in {*self._copies, *(link.spec.id for link in self._former)}:
            self.forget(link_id)

    # Links to copies

    def _is_awaited(self, link: Link) -> bool:
        copy = self._copies.get(link.spec.id)
        if copy is None or copy is link:
            return False
        return link.spec.dial and copy.spec.address == link.spec.address

    def _copy_dialed(self, link: Link, carrier: Carrier) -> None:
        """Take a connection of a peer's copy."""
        self._give_up(link.spec.id)
        self._stand_by(link, link.spec).attach(carrier)

    def _stand_by(self, link: Link, spec: LinkSpec) -> Link:
        copy = self._copies[spec.id] = self._links.make(spec)
        copy.is_standby = True
        copy.on_take = partial(self._take_over, spec.id)
        self._links.include(copy)
        for channel in link:
            self._add_twin(channel, copy)
        return copy

    def _add_twin(self, channel: Channel, copy: Link) -> None:
        twin = Channel(channel.spec, channel.slot, copy, self._backlog)
        twin.slot.add_other(twin)
        copy.add(twin)

    def _give_up(self, link_id: str) -> None:
        """End the link to a peer's copy, if there is one."""
        if (timer := self._timers.pop(link_id, None)) is not None:
            timer.cancel()
        copy = self._copies.pop(link_id, None)
        if copy is not None:
            self._end(copy)

    def _end(self, link: Link) -> None:
        self._links.exclude(link)
        for channel in link:
            channel.slot.remove_other(channel)

    # Taking over

    def _take_over(self, link_id: str) -> None:
        """Let the link to a peer's copy take the place of the present one."""
        if (timer := self._timers.pop(link_id, None)) is not None:
            timer.cancel()
        link = self._copies.pop(link_id, None)
        if link is None:
            return
        former = self._links[link_id]
        _log.debug("link %s to %s: the peer was moved", link_id, link.spec.peer)
        link.is_standby = False
        # The spec that names the new places may have come while the link stood by.
        link.spec = replace(link.spec, epoch=former.spec.epoch, peer_epoch=former.spec.peer_epoch)
        self._links.exchange(former, link)
        for channel in former:
            twin = link.get(channel.number)
            assert twin is not None
            self._channels.replace(twin)
            channel.slot.replace(channel, twin)
        former.leave()
        self._former[former] = self._tasks.spawn(self._finish(former), name=f"last answers on {link_id}")

    async def _finish(self, former: Link) -> None:
        """End a former link when it is quiet."""
        loop = asyncio.get_running_loop()
        last, heard = loop.time() + self._timeouts.former, former.traffic[0]
        quiet_at = loop.time() + self._timeouts.quiet
        while former.carrier is not None and loop.time() < last:
            if former.traffic[0] != heard or any(channel.is_busy for channel in former):
                heard, quiet_at = former.traffic[0], loop.time() + self._timeouts.quiet
            elif loop.time() >= quiet_at:
                break
            await asyncio.sleep(_LOOK)
        del self._former[former]
        self._end(former)
