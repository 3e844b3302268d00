"""Places containers: new ones, waiting ones, and those that lost their machine.

- A container that is asked for while no container machine is connected waits for one: robots may start
  before their cloud.
- Else, if no machine that is connected, or may still come back, takes it, it is refused, unless it was asked
  for with ``wait``.
- Whenever there may be room, those that wait are looked at in the order in which they were asked for, and
  each that fits is placed: one passes another only while that one fits nowhere. No room is kept free for
  large ones, because the end of a container cannot be predicted; an operator makes room by ``rce drain`` or
  ``rce resize``.
- A command looks at as many as :attr:`StateSettings.max_work` allows; the next ones continue there
  (:mod:`rce_master.state.waiting`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce_master.exceptions import NoRoomError
from rce_master.state import capacity, endpoints, volumes
from rce_master.state.lifecycle import ContainerEvent
from rce_master.state.placement import Room, best_of, refusals
from rce_master.state.records import Container, ContainerLive
from rce_master.state.tables import WAITING

if TYPE_CHECKING:
    from collections.abc import Collection

    from rce.model import Resources
    from rce_master.state.changes import Transaction
    from rce_master.state.tables import Tables

_LOOK = 8
"""The work of looking at a container, as :attr:`StateSettings.max_work` counts it; then of placing one, and
of telling its user that it waits. Each machine that is looked at for it counts beside that."""
_PLACING = 200
_TELLING = 100


def admit(tx: Transaction, container: Container, *, wait: bool) -> None:
    """Refuse a new container that no machine takes, or tell its user that it waits.

    Raises:
        NoRoomError: No machine takes it, and its user does not want to wait.
    """
    if not tx.tables.rooms.is_any_connected or _is_admitted(tx.tables, container):
        return
    why = _why_nowhere(tx, container, {})
    if not wait:
        raise NoRoomError(
            f"no machine takes container {container.tag!r} now: {why}; to wait for room, ask with wait"
        )
    _tell(tx, container, why)


def _is_admitted(tables: Tables, container: Container) -> bool:
    """Whether a machine takes a container now or soon: it may be away, or still end what it was before."""

    def admits(process: str) -> bool:
        return volumes.admits(tables, container, process)

    requested, tied = container.resources, capacity.tied_to(tables, container)
    if tables.rooms.candidates(requested, admits, among=tied, most=1).rooms:
        return True
    return any(
        room.fits(requested) and (tied is None or room.process in tied) and admits(room.process)
        for room in tables.rooms.away
    )


def place_waiting(tx: Transaction) -> None:
    """Place the unplaced containers that fit on a machine."""
    queue, rooms = tx.tables.queue, tx.tables.rooms
    too_much: set[tuple[int | None, Resources]] = set()
    for look in queue.looks():
        if tx.is_out_of_work():
            return
        container = tx.tables.container(look.id)
        assert container is not None
        tx.spend(_LOOK)
        # Rooms only fill up here: what found none finds none later, but the next pass offers other machines.
        hopeless = (None if look.among is None else look.pass_number, container.resources)
        if hopeless in too_much:
            continue
        found = rooms.candidates(container.resources, _anywhere, among=look.among, most=1)
        if not found.rooms:
            tx.spend(found.looks)
            too_much.add(hopeless)
            continue
        room = best(tx, container, look.among)
        if room is None:
            continue
        told = tx.tables.container_live(container.id).told
        if volumes.come_from_elsewhere(tx.tables, container, room.process):
            volumes.begin_restore(tx, container, room.process)
            continue
        bind(tx, container, room.process)
        tx.spend(_PLACING)
        if told:
            tx.notify(container.user, f"container {container.tag!r} has a machine now: {room.name}")


def _anywhere(_: str) -> bool:
    return True


def best(tx: Transaction, container: Container, among: Collection[str] | None = None) -> Room | None:
    """Choose the machine for a container.

    Args:
        tx: The transaction.
        container: The container.
        among: Processes of the only machines that may be taken; None: all.

    Returns:
        The best of the candidates; None if no machine takes it.
    """
    tables = tx.tables
    tied = capacity.tied_to(tables, container)
    if tied is not None:
        among = tied if among is None else [process for process in among if process in tied]
    company = capacity.company(tables, container)
    found = tables.rooms.candidates(
        container.resources, capacity.admission(tables, container), among=among, near=company
    )
    tx.spend(found.looks)
    own = tables.rooms.of_user(container.user)
    return best_of(found.rooms, container.resources, company=company, own=own)


def bind(tx: Transaction, container: Container, process: str) -> None:
    """Make a task set responsible for a container."""
    endpoints.assign(tx, container, process)
    volumes.bind(tx, container, process)
    happened(tx, container.id, ContainerEvent.PLACE)
    tx.happen("container_placed", container.id, f"at {process}")


def happened(tx: Transaction, id_: str, event: ContainerEvent) -> None:
    """Note a step in a container's life."""
    live = tx.tables.container_live(id_)
    tx.put(replace(live.after(event, tx.now), told=False, stays=""))


def tell_waiting(tx: Transaction) -> None:
    """Tell users once of containers that have been waiting for a machine for long."""
    texts: dict[Resources, str] = {}
    for live in tx.tables.live.by("untold", WAITING):
        assert isinstance(live, ContainerLive)
        if tx.now - live.since < tx.settings.placement_timeout:
            continue
        if live.id in tx.tables.volume_moves:
            continue  # it has a machine, which restores its volumes, or tries that again soon
        if tx.is_out_of_work():
            return
        container = tx.tables.container(live.id)
        assert container is not None
        tx.spend(_TELLING)
        _tell(tx, container, _why_nowhere(tx, container, texts))


def _tell(tx: Transaction, container: Container, why: str) -> None:
    text = f"container {container.tag!r} waits for a machine and starts as soon as one takes it: {why}"
    tx.put(replace(tx.tables.container_live(container.id), told=True, stays=why))
    tx.notify(container.user, text)
    tx.happen("container_waiting", container.id, text)


def _why_nowhere(tx: Transaction, container: Container, texts: dict[Resources, str]) -> str:
    """Say why no machine takes a container.

    Args:
        tx: The transaction.
        container: The container.
        texts: The texts for containers that are not bound to a machine, which others like them use too.
    """
    requested, tables, rooms = container.resources, tx.tables, tx.tables.rooms
    if not rooms.is_any_connected:
        return "no container task set is connected"
    place, tied = volumes.tied_to(tables, container), capacity.tied_to(tables, container)
    connected = rooms.connected
    if place and all(room.process != place for room in connected):
        return volumes.why_away(tables, container)
    if tied is None and requested in texts:
        return texts[requested]
    tx.spend(2 * len(connected))
    admits = capacity.admission(tables, container)
    open_ = [room for room in connected if (tied is None or room.process in tied) and admits(room.process)]
    if not open_ and tied is not None:
        return f"the machine with its group {requested.group!r} is away"
    text = refusals(open_, requested)
    if text and tied is None and len(open_) == len(connected):
        texts[requested] = text
    return text or "what it was before is still ending"
