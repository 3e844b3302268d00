"""The containers that wait for a machine, and which of them have to be looked at.

A container that was looked at and found no machine is looked at again only if something changed for it: a
machine has more room than before (it is *offered* to all that wait, in their order), or the container itself,
or its group, changed. So a new container costs the same however many wait.

A *pass* goes through the queue in the order in which the containers were asked for. It may be paused, and
continues with later commands. What gains room meanwhile is offered in the next pass: none of those behind
takes it before those in front.

The lists of what is to be looked at are not part of a transaction. One that is undone writes to the tables
again, which adds to the lists and removes nothing from them, so nothing is overlooked.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from typing import TYPE_CHECKING, NamedTuple

from rce.model import Network
from rce_master.state.records import Container

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from rce_master.state.records import Endpoint, Tombstone
    from rce_master.state.table import Table
    from rce_master.state.volume_records import VolumeRemoval


class Look(NamedTuple):
    """A container for which a machine is to be found."""

    id: str
    among: Collection[str] | None
    """The only machines that it has not been refused by, by process; None: it may be any."""
    pass_number: int
    """Of the pass, which offers the same machines to all that it looks at."""


def group_key(container: Container) -> str:
    """Return the key of a container's group in the index ``group``; empty if it is in none."""
    requested = container.resources
    if requested.group or requested.network is Network.GROUP:
        return f"{container.user} {requested.group}"
    return ""


class PlacementQueue:
    """The containers without a machine, in the order in which they were asked for.

    Args:
        endpoints: The containers; with the index ``group`` by :func:`group_key`.
        tombstones: Containers that still end somewhere.
        volume_removals: Volumes that machines still remove.
    """

    def __init__(
        self,
        endpoints: Table[Endpoint],
        tombstones: Table[Tombstone],
        volume_removals: Table[VolumeRemoval],
    ) -> None:
        self._endpoints = endpoints
        self._line: list[tuple[int, str]] = []
        """Numbers and ids of all that wait."""
        self._unseen: dict[str, int] = {}
        """Numbers, by id, of those that have to be compared with all machines."""
        self._gained: dict[str, None] = {}
        """Machines to offer in the next pass."""
        self._offered: dict[str, None] = {}
        """Machines that are offered in this pass."""
        self._reached: int | None = None
        """Number of the last container of this pass; None: no pass is under way."""
        self._pass_number = 0
        endpoints.watch(self._endpoint_changed)
        tombstones.watch(self._tombstone_changed)
        volume_removals.watch(self._removal_changed)

    def __len__(self) -> int:
        return len(self._line)

    @property
    def waiting(self) -> list[str]:
        """The ids of all that wait, in their order."""
        return [id_ for _, id_ in self._line]

    @property
    def has_work(self) -> bool:
        """Whether any has to be looked at."""
        return bool(self._unseen or self._gained or self._reached is not None)

    def offer(self, process: str) -> None:
        """Note that a machine may have more room than before."""
        if self._line:
            self._gained[process] = None

    def retry(self, container: Container) -> None:
        """Look at a container again that waits: machines may take it that did not before."""
        if not container.task_set:
            self._unseen[container.id] = container.number

    def looks(self) -> Iterator[Look]:
        """Iterate over the containers that have to be looked at, until none has.

        One that is left out, because the iteration stops at it, is the first of the next iteration.
        """
        while self.has_work:
            if self._reached is None:
                self._offered, self._gained = self._gained, {}
                self._reached = 0
                self._pass_number += 1
            for number, id_ in self._rest(self._reached):
                yield Look(id_, None if id_ in self._unseen else self._offered, self._pass_number)
                self._unseen.pop(id_, None)
                self._reached = number
            self._reached = None
            self._offered = {}

    def _rest(self, reached: int) -> list[tuple[int, str]]:
        if self._offered:
            return self._line[bisect_left(self._line, (reached + 1, "")) :]
        return sorted((number, id_) for id_, number in self._unseen.items() if number > reached)

    def _endpoint_changed(self, before: Endpoint | None, after: Endpoint | None) -> None:
        was = before if isinstance(before, Container) else None
        now = after if isinstance(after, Container) else None
        waited, waits = was is not None and not was.task_set, now is not None and not now.task_set
        if was is not None and waited and not (now is not None and waits and now.number == was.number):
            self._remove(was)
        if now is not None and waits:
            if was is None or not waited or now.number != was.number:
                insort(self._line, (now.number, now.id))
                self._unseen[now.id] = now.number
            elif now.resources != was.resources:
                self._unseen[now.id] = now.number
        if (was.task_set if was is not None else "") != (now.task_set if now is not None else ""):
            for one in (was, now):
                if one is not None and one.resources.network is Network.GROUP:
                    self._retry_group(group_key(one))

    def _remove(self, container: Container) -> None:
        del self._line[bisect_left(self._line, (container.number, container.id))]
        self._unseen.pop(container.id, None)

    def _retry_group(self, key: str) -> None:
        """Look at the waiting containers of a group again: they are bound to the machines of the others."""
        if not self._line:
            return
        for mate in self._endpoints.by("group", key):
            if isinstance(mate, Container) and not mate.task_set:
                self._unseen[mate.id] = mate.number

    def _tombstone_changed(self, before: Tombstone | None, after: Tombstone | None) -> None:
        if before is not None and after is None:
            self.offer(before.process)

    def _removal_changed(self, before: VolumeRemoval | None, after: VolumeRemoval | None) -> None:
        if before is not None and after is None:
            self.offer(before.process)
