"""Volumes: folders of users on container machines, which outlive the containers that write to them.

A volume is reserved with the first container that asks for it. It is on the machine where that container is
placed, and containers with it are placed only there. One container has it at a time. It is removed when its
user asks for that; the machine then removes the folder, at once or when it comes back.

It gets another machine when its container is moved (:mod:`rce_master.state.volume_moves`), or when its
machine is lost and the masters hold a snapshot of it. Each time its *placement* gets the next number. A
folder of an earlier placement is removed when its container is up at the new one, not before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.control import VolumePlacement
from rce.model import MEGABYTE, Resources
from rce_master.exceptions import ConflictError, LimitReachedError, NotFoundError
from rce_master.state import limits
from rce_master.state.lifecycle import VOLUME_MOVE_LIFE, VolumeMoveEvent, VolumeMovePhase
from rce_master.state.records import Container, Endpoint
from rce_master.state.volume_records import (
    UserVolume,
    VolumeMove,
    VolumeRemoval,
    user_volume_key,
    volume_removal_key,
)

if TYPE_CHECKING:
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import RemoveVolume, SnapshotLost, VolumeRemoved
    from rce_master.state.tables import Tables


def check(tx: Transaction, user: str, id_: str, requested: Resources) -> None:
    """Check that a new container may have the volumes that it asks for.

    Raises:
        ConflictError: Another container has one, or it exists with more room, or they are on two machines.
        LimitReachedError: The user may not have that much.
    """
    more = 0
    places: dict[str, str] = {}
    for volume in requested.volumes:
        holder = holder_of(tx.tables, user, volume.name)
        if holder is not None and holder.id != id_:
            raise ConflictError(
                f"volume {volume.name!r} belongs to container {holder.tag!r}: one container at a time "
                "writes to a volume; destroy that container first, or use another volume"
            )
        there = tx.tables.volumes.get(user_volume_key(user, volume.name))
        if there is not None and there.size > volume.size:
            raise ConflictError(
                f"volume {volume.name!r} has {_megabytes(there.size)} and cannot shrink to "
                f"{_megabytes(volume.size)}; ask for at least {_megabytes(there.size)}, or remove it first "
                f"(rce volume remove {volume.name})"
            )
        if there is not None and there.process:
            places[there.process] = volume.name
        more += limits.disk_of(volume.size, volume.snapshots)
        more -= limits.disk_of(there.size, there.snapshots) if there is not None else 0
    if len(places) > 1:
        names = " and ".join(map(repr, places.values()))
        raise ConflictError(f"volumes {names} are on different machines; a container can have one of them")
    if more > 0:
        _check_disk(tx, user, more)


def _check_disk(tx: Transaction, user: str, more: int) -> None:
    limit = limits.limit_of(tx.tables, tx.settings, user, "disk")
    used = limits.used_of(tx.tables, user)["disk"] + more
    if limit.most and used > limit.most:
        raise LimitReachedError(
            f"your packages and volumes would take {_megabytes(used)} of disk, and you may have "
            f"{_megabytes(limit.most)}; remove a volume (rce volume remove) or a package, or have an "
            f"administrator allow more: rce user limit {user} --disk"
        )


def reserve(tx: Transaction, container: Container) -> None:
    """Note the volumes of a new container; those that exist grow to its size."""
    for volume in container.resources.volumes:
        there = tx.tables.volumes.get(user_volume_key(container.user, volume.name))
        known = there or UserVolume(user=container.user, name=volume.name, size=volume.size)
        tx.put(replace(known, size=volume.size, snapshots=volume.snapshots))
        if there is None:
            tx.happen("volume_requested", known.id, _megabytes(volume.size))


def bind(tx: Transaction, container: Container, process: str) -> None:
    """Note that the volumes of a container are on its machine, where those of a snapshot were restored."""
    for known in volumes_of(tx.tables, container):
        if known.process == process:
            continue
        former = (*known.former, *((known.process,) if known.process else ()))
        tx.put(
            replace(
                known,
                process=process,
                placement=known.placement + 1,
                is_restored=bool(known.process),
                is_returned=False,
                former=tuple(one for one in dict.fromkeys(former) if one != process),
            )
        )


def placements(tables: Tables, endpoint: Endpoint) -> tuple[VolumePlacement, ...]:
    """Return which files a container is to have."""
    if not isinstance(endpoint, Container) or not endpoint.resources.volumes:
        return ()
    return tuple(
        VolumePlacement(name=known.name, number=known.placement, is_new=not known.is_restored)
        for known in volumes_of(tables, endpoint)
    )


def begin_restore(tx: Transaction, container: Container, process: str) -> None:
    """Have a machine make the files of a container's volumes, whose machine is lost; then place it there."""
    phase = VOLUME_MOVE_LIFE.advance(VolumeMovePhase.DONE, VolumeMoveEvent.RESTORE, container.id, ())
    tx.put(VolumeMove(id=container.id, to=process, phase=phase, since=tx.now))
    tx.changes.volume_moves.append(container.id)
    tx.happen("container_moving", container.id, f"to {process}, with the last snapshots of its volumes")


def end_move(tx: Transaction, container: Container) -> None:
    """End a container's move with its volumes, if there is one; what the next machine has made is removed."""
    move = tx.tables.volume_moves.get(container.id)
    if move is None:
        return
    discard_restored(tx, container, move)
    tx.delete(tx.tables.volume_moves, move.id)


def discard_restored(tx: Transaction, container: Container, move: VolumeMove) -> None:
    """Have the next machine of a move remove what it has made of the volumes."""
    if move.phase is VolumeMovePhase.RESTORING:
        for known in volumes_of(tx.tables, container):
            _remove_files(tx, known, move.to)


def remove_former(tx: Transaction, container: Container) -> bool:
    """Have the folders of earlier placements removed, since the container is up at the newest one.

    Returns:
        Whether there were any.
    """
    moved = False
    for known in volumes_of(tx.tables, container):
        if not known.former:
            continue
        for process in known.former:
            _remove_files(tx, known, process)
        moved = True
        kept = replace(known, former=(), is_returned=False)
        # What is not declared is not kept: this snapshot was made for the move.
        tx.put(kept if known.snapshots else replace(kept, snapshot="", kept=0, taken=0.0))
    return moved


def _remove_files(tx: Transaction, known: UserVolume, process: str) -> None:
    removal = VolumeRemoval(process=process, volume=known.id)
    tx.put(removal)
    tx.changes.volume_removals.append(removal)


def release(tx: Transaction, container: Container) -> None:
    """Forget the volumes of a removed container that never reached a machine."""
    for volume in container.resources.volumes:
        known = tx.tables.volumes.get(user_volume_key(container.user, volume.name))
        if known is not None and not known.process:
            tx.delete(tx.tables.volumes, known.id)


def remove(tx: Transaction, command: RemoveVolume) -> None:
    """Remove a volume with its files.

    Raises:
        NotFoundError: It does not exist.
        ConflictError: A container has it.
    """
    known = tx.tables.volumes.get(user_volume_key(command.user, command.name))
    if known is None:
        raise NotFoundError(f"there is no volume {command.name!r}; rce volume list lists them")
    holder = holder_of(tx.tables, command.user, command.name)
    if holder is not None:
        raise ConflictError(
            f"volume {command.name!r} belongs to container {holder.tag!r}; destroy that container first"
        )
    _remove(tx, known)


def forget_user(tx: Transaction, user: str) -> None:
    """Remove all volumes of a user who is removed; their containers are gone already."""
    for known in tx.tables.volumes.by("user", user):
        _remove(tx, known)


def _remove(tx: Transaction, known: UserVolume) -> None:
    tx.delete(tx.tables.volumes, known.id)
    for process in (known.process, *known.former):
        if process:
            _remove_files(tx, known, process)
    tx.happen("volume_removed", known.id)


def removed(tx: Transaction, command: VolumeRemoved) -> None:
    """Note that a machine has removed a volume's files."""
    key = volume_removal_key(command.process, command.volume)
    tx.delete(tx.tables.volume_removals, key)


def forget_snapshot(tx: Transaction, command: SnapshotLost) -> None:
    """Forget a snapshot of a volume that the masters do not hold."""
    known = tx.tables.volumes.get(command.volume)
    if known is not None and known.snapshot == command.snapshot:
        tx.put(replace(known, snapshot="", kept=0, taken=0.0))
        tx.happen("snapshot_lost", known.id, "the master does not hold it")


def holder_of(tables: Tables, user: str, name: str) -> Container | None:
    """Return the container that has a volume; None if none has."""
    found = tables.endpoints.by("volume", user_volume_key(user, name))
    return next((one for one in found if isinstance(one, Container)), None)


def volumes_of(tables: Tables, container: Container) -> list[UserVolume]:
    """Return what is known of a container's volumes."""
    keys = (user_volume_key(container.user, volume.name) for volume in container.resources.volumes)
    return [known for key in keys if (known := tables.volumes.get(key)) is not None]


def tied_to(tables: Tables, container: Container) -> str:
    """Return the process of the machine where a container's volumes are; empty if it can be anywhere."""
    if not container.resources.volumes:
        return ""
    found = volumes_of(tables, container)
    return next((one.process for one in found if one.process and not _is_abandoned(tables, one)), "")


def _is_abandoned(tables: Tables, known: UserVolume) -> bool:
    """Whether the machine of a volume is lost, so that its last snapshot counts."""
    return bool(known.snapshot) and known.process not in tables.task_sets


def admits(tables: Tables, container: Container, process: str, *, moves: bool = False) -> bool:
    """Whether a machine may have a container, as far as its volumes are concerned.

    Args:
        tables: The tables.
        container: The container.
        process: Of the machine.
        moves: Whether its volumes may be moved there.
    """
    if not container.resources.volumes:
        return True
    found = volumes_of(tables, container)
    if container.id in tables.volume_moves:
        return False
    if any(volume_removal_key(process, known.id) in tables.volume_removals for known in found):
        return False
    if not come_from_elsewhere(tables, container, process):
        return True
    task_set = tables.task_sets.get(process)
    if task_set is None or not task_set.snapshots:
        return False
    return moves or not tied_to(tables, container)


def come_from_elsewhere(tables: Tables, container: Container, process: str) -> bool:
    """Whether a machine would need the files of a container's volumes from another one."""
    return any(known.process not in ("", process) for known in volumes_of(tables, container))


def why_away(tables: Tables, container: Container) -> str:
    """Say why a container waits for the machine of its volumes, which is away, and what can be done."""
    found = [known for known in volumes_of(tables, container) if known.process]
    names = ", ".join(known.name for known in found)
    text = f"the machine with its volumes ({names}) is away: {found[0].process}"
    without = ", ".join(known.name for known in found if not known.snapshot)
    if not without:
        return text
    return (
        f"{text}; there is no snapshot of {without}, so start that machine again, or give the files up: "
        "destroy the container and run rce volume remove; later, ask for snapshots of the volume"
    )


def _megabytes(count: float) -> str:
    return f"{count / MEGABYTE:.0f} MB"
