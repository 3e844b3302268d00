"""Moves of containers with volumes: one ends, its files go to the next machine, and it starts there.

A container without volumes is copied while it continues (:mod:`rce_master.state.draining`). One that writes
files cannot be in two places, so it is *held*: while there is a :class:`VolumeMove`, no task set is told to
run it.

1. STOPPING: its machine saves the states of its nodes and ends it, so that they end properly.
2. SAVING: its machine sends a snapshot of each volume to the masters, which need only what they lack.
3. RESTORING: the next machine makes the files. A container whose machine is lost begins here.
4. It belongs to the next machine. The former folders are removed when it is up there.

A failure before the last step lets the container start again at its machine, whose files are as it left them.
If it fails to start after the last step, it goes back by a move in the other direction. If it fails there,
too, it stays. The record is stored, so another master continues in the same phase.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.control import LinkAddress, RestoreVolume, SaveVolume
from rce_master.state import activity, capacity, endpoints, placing, volumes
from rce_master.state.lifecycle import VOLUME_MOVE_LIFE, ContainerEvent, VolumeMoveEvent, VolumeMovePhase
from rce_master.state.records import Container, tombstone_key
from rce_master.state.volume_records import UserVolume, VolumeMove, volume_removal_key

if TYPE_CHECKING:
    from rce.control import ToTaskSet
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import SnapshotTaken, VolumeRestored
    from rce_master.state.tables import Tables


def begin(tx: Transaction, container: Container, to: str) -> None:
    """Begin to move a container with its volumes."""
    phase = VOLUME_MOVE_LIFE.advance(VolumeMovePhase.DONE, VolumeMoveEvent.BEGIN, container.id, ())
    tx.put(VolumeMove(id=container.id, to=to, phase=phase, since=tx.now))
    tx.put(replace(tx.tables.container_live(container.id), stays=""))
    if tx.tables.is_connected(container.task_set):
        reason = "it moves to another machine with its volumes"
        tx.withdraw(container.task_set, container.id, reason, elsewhere=True)
    tx.happen("container_moving", container.id, f"from {container.task_set} to {to}, with its volumes")


def why_not(tables: Tables, container: Container) -> str:
    """Say why a container with volumes cannot be moved to any machine; empty if it can."""
    if capacity.group_mates(tables, container):
        return (
            f"container {container.tag!r} has volumes and is in the network of a group, whose containers "
            "move together; such a container stays"
        )
    task_set = tables.task_sets.get(container.task_set)
    if task_set is not None and not task_set.snapshots:
        return (
            f"the volumes of container {container.tag!r} are on this machine and stay there: it runs an "
            "earlier release, which does not save volumes; upgrade it"
        )
    return ""


def orders(tables: Tables, move: VolumeMove) -> list[tuple[str, ToTaskSet]]:
    """Return what task sets have to be told in the present phase of a move: process names and messages."""
    container = tables.container(move.id)
    assert container is not None
    left = [known for known in volumes.volumes_of(tables, container) if known.name not in move.done]
    if move.phase is VolumeMovePhase.SAVING:
        return [(container.task_set, SaveVolume(volume=one.id, placement=one.placement)) for one in left]
    if move.phase is VolumeMovePhase.RESTORING:
        return [(move.to, _restoring(known)) for known in left]
    return []


def _restoring(known: UserVolume) -> RestoreVolume:
    return RestoreVolume(
        volume=known.id, placement=known.placement + 1, snapshot=known.snapshot, size=known.size
    )


def describe(move: VolumeMove) -> str:
    """Say what is being done, for users."""
    doing = {
        VolumeMovePhase.STOPPING: f"moves to {move.to}: it is being ended",
        VolumeMovePhase.SAVING: f"moves to {move.to}: its volumes are being saved",
        VolumeMovePhase.RESTORING: f"moves to {move.to}: its volumes are being restored there",
        VolumeMovePhase.RESTING: "its volumes could not be restored; this is tried again",
    }
    return doing[move.phase]


# Progress


def stopped(tx: Transaction, container: Container, move: VolumeMove) -> None:
    """Note that a container has ended that moves; without effect if that is known."""
    if move.phase is not VolumeMovePhase.STOPPING:
        return
    tx.put(replace(tx.tables.container_live(container.id), status=None))
    activity.forget(tx, container.id)
    endpoints.note_address(tx, container.id, LinkAddress())
    placing.happened(tx, container.id, ContainerEvent.STOPPING)
    _advance(tx, move, VolumeMoveEvent.STOPPED)


def phase_began(tables: Tables, volume: str) -> float | None:
    """Return when the present phase of a volume's move began; None if it does not move.

    Args:
        tables: The tables.
        volume: ``user/name``.
    """
    known = tables.volumes.get(volume)
    container = None if known is None else volumes.holder_of(tables, known.user, known.name)
    move = None if container is None else tables.volume_moves.get(container.id)
    return None if move is None else move.since


def snapshot_taken(tx: Transaction, command: SnapshotTaken) -> None:
    """Note a snapshot of a volume, or that it failed; one of another placement counts for nothing."""
    known = tx.tables.volumes.get(command.volume)
    if known is None or (known.process, known.placement) != (command.process, command.placement):
        return
    container = volumes.holder_of(tx.tables, known.user, known.name)
    move = None if container is None else tx.tables.volume_moves.get(container.id)
    is_awaited = (
        command.is_last
        and move is not None
        and move.phase is VolumeMovePhase.SAVING
        and move.since
        == command.since  # an answer to the order of an earlier move lacks what was written since
    )
    if command.error:
        if is_awaited and move is not None:
            give_up(tx, move, f"volume {known.name!r} could not be saved: {command.error}")
        elif command.error != known.fault:
            tx.put(replace(known, fault=command.error))
            tx.happen("snapshot_failed", known.id, command.error)
        return
    if move is not None and move.phase is not VolumeMovePhase.STOPPING and not is_awaited:
        return
    tx.put(replace(known, snapshot=command.snapshot, kept=command.size, taken=command.taken, fault=""))
    if container is not None:
        tx.tables.queue.retry(container)
    if is_awaited and move is not None and _note_done(tx, move, known):
        _advance(tx, tx.tables.volume_moves[move.id], VolumeMoveEvent.SAVED)


def restored(tx: Transaction, command: VolumeRestored) -> None:
    """Note that the next machine has a volume's files, or could not make them."""
    known = tx.tables.volumes.get(command.volume)
    container = None if known is None else volumes.holder_of(tx.tables, known.user, known.name)
    move = None if container is None else tx.tables.volume_moves.get(container.id)
    if (
        known is None
        or container is None
        or move is None
        or move.phase is not VolumeMovePhase.RESTORING
        or (move.to, known.placement + 1) != (command.process, command.placement)
        or not tx.tables.is_connected(command.process)
    ):
        return
    if command.error:
        give_up(tx, move, f"{move.to}: volume {known.name!r} could not be restored: {command.error}")
    elif _note_done(tx, move, known):
        _hand_over(tx, container, tx.tables.volume_moves[move.id])


def _note_done(tx: Transaction, move: VolumeMove, known: UserVolume) -> bool:
    """Note that the present phase is done with a volume; return whether it is with all."""
    done = tuple(dict.fromkeys((*move.done, known.name)))
    tx.put(replace(move, done=done))
    container = tx.tables.container(move.id)
    assert container is not None
    return {volume.name for volume in container.resources.volumes} <= set(done)


def _hand_over(tx: Transaction, container: Container, move: VolumeMove) -> None:
    if tombstone_key(move.to, container.id) in tx.tables.tombstones:
        give_up(tx, move, f"{move.to}: a container of its name is still ending there")
        return
    if capacity.is_tied_elsewhere(tx.tables, container, move.to):
        give_up(tx, move, f"{move.to}: a container joined its group meanwhile, on another machine")
        return
    returns = any(move.to in known.former for known in volumes.volumes_of(tx.tables, container))
    _advance(tx, move, VolumeMoveEvent.RESTORED)
    placing.bind(tx, container, move.to)
    if returns:
        for known in volumes.volumes_of(tx.tables, container):
            tx.put(replace(known, is_returned=True))
        _rest(tx, container)


def reported(tx: Transaction, container: Container, *, is_up: bool, failed: str) -> None:
    """Finish a move whose container is up at its new machine; let one that failed there go back.

    Args:
        tx: The transaction.
        container: The container.
        is_up: Whether its environment answers.
        failed: Why it could not be started or ended; empty if it was not.
    """
    if not container.resources.volumes or container.id in tx.tables.volume_moves:
        return
    if is_up:
        if volumes.remove_former(tx, container):
            tx.happen("container_moved", container.id, f"to {container.task_set}, with its volumes")
    elif failed:
        _go_back(tx, container, failed)


def _go_back(tx: Transaction, container: Container, why: str) -> None:
    """Move a container that failed at its new machine back to the one before, if that can have it.

    One that came back already stays: it would fail there again.
    """
    tables = tx.tables
    known = next((known for known in volumes.volumes_of(tables, container) if known.former), None)
    if known is None:
        return
    home = known.former[-1]
    if known.is_returned:
        _stay(tx, container, f"it failed at {home}, and after its return here, too: {why}")
        return
    task_set = tables.task_sets.get(home)
    if task_set is None or not task_set.snapshots or not tables.is_connected(home):
        return
    if capacity.is_tied_elsewhere(tables, container, home):
        return
    if tombstone_key(home, container.id) in tables.tombstones or _is_removing(tables, container, home):
        return
    if capacity.room_at(tables, task_set).shortages(container.resources):
        return
    _stay(tx, container, f"{container.task_set}: it failed there: {why}; it goes back to {home}")
    begin(tx, container, home)


def _is_removing(tables: Tables, container: Container, process: str) -> bool:
    return any(
        volume_removal_key(process, known.id) in tables.volume_removals
        for known in volumes.volumes_of(tables, container)
    )


def _advance(tx: Transaction, move: VolumeMove, event: VolumeMoveEvent) -> None:
    phase = VOLUME_MOVE_LIFE.advance(move.phase, event, move.id, ())
    if phase is VolumeMovePhase.DONE:
        tx.delete(tx.tables.volume_moves, move.id)
        return
    tx.put(replace(move, phase=phase, done=(), since=tx.now))
    tx.changes.volume_moves.append(move.id)


# Ends that are not the intended one


def give_up(tx: Transaction, move: VolumeMove, why: str) -> None:
    """End a move that failed: the container starts again where it was, or another machine is searched for."""
    container = tx.tables.container(move.id)
    assert container is not None
    volumes.discard_restored(tx, container, move)
    if container.task_set:
        _resume(tx, container, move)
        _rest(tx, container)
        _stay(tx, container, why)
        return
    tx.put(
        replace(
            move,
            to="",
            phase=VOLUME_MOVE_LIFE.advance(move.phase, VolumeMoveEvent.FAIL, move.id, ()),
            since=tx.now,
        )
    )
    tx.happen("container_stays", container.id, f"without a machine: {why}", user="")


def call_back(tx: Transaction, container: Container) -> None:
    """End a move that is not wanted any more."""
    move = tx.tables.volume_moves.get(container.id)
    if move is not None and container.task_set:
        volumes.discard_restored(tx, container, move)
        _resume(tx, container, move)


def _resume(tx: Transaction, container: Container, move: VolumeMove) -> None:
    """Let a container run at its machine again."""
    _advance(tx, move, VolumeMoveEvent.GIVE_UP)
    if move.phase is not VolumeMovePhase.STOPPING:
        placing.happened(tx, container.id, ContainerEvent.PLACE)
    tx.touch(container.id)


def _rest(tx: Transaction, container: Container) -> None:
    """Let no drain move a container for a while."""
    again = tx.now + tx.settings.move_rest
    tx.put(replace(tx.tables.container_live(container.id), rest_until=again))


def _stay(tx: Transaction, container: Container, why: str) -> None:
    live = tx.tables.container_live(container.id)
    if live.stays == why:
        return
    tx.put(replace(live, stays=why))
    tx.happen("container_stays", container.id, f"at {container.task_set}: {why}", user="")


def left(tx: Transaction, process: str) -> None:
    """End the moves to a task set that disconnected."""
    for move in list(tx.tables.volume_moves.by("to", process)):
        give_up(tx, move, f"{process}: it went away")


def lost(tx: Transaction, container: Container) -> None:
    """Note that the machine of a container is lost, which may be moving: saved volumes are still restored."""
    move = tx.tables.volume_moves.get(container.id)
    if move is not None and move.phase is not VolumeMovePhase.RESTORING:
        volumes.end_move(tx, container)


def found_again(tx: Transaction, process: str) -> None:
    """Note that a machine came back that counted as lost: its files are newer than snapshots of them."""
    for known in tx.tables.volumes.by("process", process):
        container = volumes.holder_of(tx.tables, known.user, known.name)
        if container is not None and not container.task_set and container.id in tx.tables.volume_moves:
            volumes.end_move(tx, container)
            tx.tables.queue.retry(container)


def gone(tx: Transaction, process: str) -> None:
    """Note that a machine is given up: containers with snapshots may be placed elsewhere."""
    left(tx, process)
    for known in tx.tables.volumes.by("process", process):
        container = volumes.holder_of(tx.tables, known.user, known.name)
        if container is not None:
            tx.tables.queue.retry(container)


def expire(tx: Transaction) -> None:
    """End phases that take too long, and pauses that are over."""
    for move in list(tx.tables.volume_moves):
        resting = move.phase is VolumeMovePhase.RESTING
        most = tx.settings.move_rest if resting else tx.settings.volume_move_timeout
        if tx.now - move.since < most:
            continue
        container = tx.tables.container(move.id)
        assert container is not None
        if resting:
            _advance(tx, move, VolumeMoveEvent.RETRY)
            tx.tables.queue.retry(container)
        else:
            give_up(tx, move, f"{describe(move)}, for more than {most:.0f} s")


def restart(tx: Transaction) -> None:
    """Begin the times of all moves anew, in a new master."""
    for move in list(tx.tables.volume_moves):
        tx.put(replace(move, since=tx.now))
