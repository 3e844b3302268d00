"""Changes what a container may use, while it runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.model import MEGABYTE, Resources, write_bandwidth, write_cores
from rce_master.exceptions import NoRoomError
from rce_master.state import capacity, endpoints, placing
from rce_master.state.containers import find

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import ResizeContainer
    from rce_master.state.records import Container


def resize_container(tx: Transaction, command: ResizeContainer) -> None:
    """Change a container's resources; the same ones again are accepted silently."""
    container = find(tx, command.user, command.tag)
    had, requested = container.resources, replace(container.resources, **command.changes.given())
    if requested == had:
        return
    capacity.check_resources(tx, command.user, container.id, requested)
    _check_room(tx, container, requested)
    size = endpoints.grown(tx, container, requested, had)
    tx.put(replace(container, resources=requested, made=container.made or had, size=size))
    tx.touch(container.id)
    tx.happen("container_resized", container.id, describe(requested))
    placing.place_waiting(tx)


def _check_room(tx: Transaction, container: Container, requested: Resources) -> None:
    """Check the machine where it is, and the one that it is on its way to."""
    had = container.resources
    move = tx.tables.moves.get(container.id) or tx.tables.volume_moves.get(container.id)
    for process in (container.task_set, move.to if move else ""):
        task_set = tx.tables.task_sets.get(process)
        if task_set is None:
            continue
        room = capacity.room_at(tx.tables, task_set)
        lacks = room.without(had).shortages(requested, had)
        if lacks:
            raise NoRoomError(
                f"container {container.tag!r} cannot grow so far: {room.name} {' and '.join(lacks)}; "
                "nothing was changed"
            )


def describe(requested: Resources) -> str:
    """Write what a container may use, as people write it."""
    parts = [f"size {requested.size}"]
    parts += [f"cpu {write_cores(requested.cpu)}"] if requested.cpu else []
    parts += [f"memory {requested.memory / MEGABYTE:g} MB"] if requested.memory else []
    parts += [f"bandwidth {write_bandwidth(requested.bandwidth)}/s"] if requested.bandwidth else []
    return ", ".join(parts)
