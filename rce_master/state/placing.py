"""Places containers: new ones, waiting ones, and those that lost their machine.

- A container that is asked for while no container machine is connected waits for one: robots may start
  before their cloud.
- Else, if no machine that is connected, or may still come back, takes it, it is refused, unless it was asked
  for with ``wait``.
- Whenever there may be room, those that wait are looked at in the order in which they were asked for, and
  each that fits is placed: one passes another only while that one fits nowhere. No room is kept free for
  large ones, because the end of a container cannot be predicted; an operator makes room by ``rce drain`` or
  ``rce resize``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce_master.exceptions import NoRoomError
from rce_master.state import capacity, volumes
from rce_master.state.lifecycle import ContainerEvent
from rce_master.state.placement import Room, choose, refusals
from rce_master.state.records import Container, ContainerLive

if TYPE_CHECKING:
    from rce.model import Resources
    from rce_master.state.changes import Transaction


def admit(tx: Transaction, container: Container, *, wait: bool) -> None:
    """Refuse a new container that no machine takes, or tell its user that it waits.

    Raises:
        NoRoomError: No machine takes it, and its user does not want to wait.
    """
    known = capacity.rooms(tx.tables, away=True)
    if not any(tx.tables.is_connected(process) for process in known):
        return
    if any(room.fits(container.resources) for room in _with_group(tx, container, known)):
        return
    why = _why_nowhere(tx, container, capacity.rooms(tx.tables))
    if not wait:
        raise NoRoomError(
            f"no machine takes container {container.tag!r} now: {why}; to wait for room, ask with wait"
        )
    _tell(tx, container, why)


def place_waiting(tx: Transaction) -> None:
    """Place every unplaced container that fits on a machine."""
    waiting = [e for e in tx.tables.endpoints.by("task_set", "") if isinstance(e, Container)]
    if not waiting:
        return
    rooms = capacity.rooms(tx.tables)
    too_much: set[Resources] = set()  # rooms only fill up here: what found none finds none later
    for container in sorted(waiting, key=lambda c: c.number):
        requested = container.resources
        if requested in too_much:
            continue
        if not any(room.fits(requested) for room in rooms.values()):
            too_much.add(requested)
            continue
        room = best(tx, container, rooms)
        if room is not None:
            told = tx.tables.container_live(container.id).told
            bind(tx, container, room.process)
            rooms[room.process] = room.with_(container.resources)
            if told:
                tx.notify(container.user, f"container {container.tag!r} has a machine now: {room.name}")


def best(tx: Transaction, container: Container, rooms: dict[str, Room]) -> Room | None:
    """Choose, of machines, the best one for a container; None if none takes it."""
    return choose(
        capacity.open_to(tx.tables, container, rooms),
        container.resources,
        company=capacity.company(tx.tables, container),
        own=capacity.own(tx.tables, container),
    )


def bind(tx: Transaction, container: Container, process: str) -> None:
    """Make a task set responsible for a container."""
    tx.put(replace(container, task_set=process))
    volumes.bind(tx, container, process)
    happened(tx, container.id, ContainerEvent.PLACE)
    tx.touch(container.id)
    tx.happen("container_placed", container.id, f"at {process}")


def happened(tx: Transaction, id_: str, event: ContainerEvent) -> None:
    """Note a step in a container's life."""
    live = tx.tables.container_live(id_)
    tx.put(replace(live.after(event, tx.now), told=False, stays=""))


def tell_waiting(tx: Transaction) -> None:
    """Tell users once of containers that have been waiting for a machine for long."""
    rooms: dict[str, Room] | None = None
    for endpoint in tx.tables.endpoints.by("task_set", ""):
        live = tx.tables.live[endpoint.id]
        if not isinstance(endpoint, Container) or not isinstance(live, ContainerLive) or live.told:
            continue
        if tx.now - live.since >= tx.settings.placement_timeout:
            rooms = capacity.rooms(tx.tables) if rooms is None else rooms
            _tell(tx, endpoint, _why_nowhere(tx, endpoint, rooms))


def _tell(tx: Transaction, container: Container, why: str) -> None:
    text = f"container {container.tag!r} waits for a machine and starts as soon as one takes it: {why}"
    tx.put(replace(tx.tables.container_live(container.id), told=True, stays=why))
    tx.notify(container.user, text)
    tx.happen("container_waiting", container.id, text)


def _why_nowhere(tx: Transaction, container: Container, rooms: dict[str, Room]) -> str:
    if not rooms:
        return "no container task set is connected"
    open_ = capacity.open_to(tx.tables, container, rooms)
    place = volumes.tied_to(tx.tables, container)
    if place and place not in rooms:
        names = ", ".join(volume.name for volume in container.resources.volumes)
        return f"the machine with its volumes ({names}) is away: {place}"
    if not open_ and capacity.group_mates(tx.tables, container):
        return f"the machine with its group {container.resources.group!r} is away"
    return refusals(open_, container.resources) or "what it was before is still ending"


def _with_group(tx: Transaction, container: Container, rooms: dict[str, Room]) -> list[Room]:
    tied = {mate.task_set for mate in capacity.group_mates(tx.tables, container) if mate.task_set}
    return [
        room
        for room in rooms.values()
        if (not tied or room.process in tied) and volumes.admits(tx.tables, container, room.process)
    ]
