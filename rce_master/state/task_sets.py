"""Task sets: arrival, departure, reports, grace times."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from rce.control import (
    SNAPSHOTS,
    EndpointState,
    EndpointStatus,
    Hello,
    StatusPatch,
    TaskSetKind,
    without_wiring,
)
from rce_master.exceptions import ConflictError, InvalidRequestError, NotFoundError
from rce_master.state import (
    activity,
    capacity,
    containers,
    draining,
    endpoints,
    handing_over,
    placing,
    robots,
    volume_moves,
    volumes,
)
from rce_master.state.commands import RobotsFound, TaskSetArrived
from rce_master.state.lifecycle import ContainerPhase, RobotSession
from rce_master.state.records import (
    Container,
    ContainerLive,
    Presence,
    Robot,
    RobotLive,
    TaskSet,
    Tombstone,
    tombstone_key,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce_master.state.changes import Transaction
    from rce_master.state.commands import (
        Continue,
        EndpointGone,
        FaultReported,
        SpecRequested,
        StatusPatched,
        StatusReported,
        TaskSetLeft,
        Tick,
    )

_LOSS = 200
"""The work of giving up a container, as :attr:`StateSettings.max_work` counts it."""
_PIECE = 1000
"""Robots, and their interfaces and connections, that a command takes of a task set that arrived."""
_PROCESS = re.compile(r"[^\s\x00-\x1f\x7f]{1,255}")


def arrival(hello: Hello) -> list[TaskSetArrived | RobotsFound]:
    """Return the commands that take a task set: of one with many robots several, none of which takes long."""
    pieces: list[list[EndpointStatus]] = []
    size = _PIECE
    for status in hello.endpoints:
        if size >= _PIECE:
            pieces.append([])
            size = 0
        pieces[-1].append(status)
        size += 1 + len(status.interfaces) + len(status.connections)
    if hello.kind is not TaskSetKind.ROBOT or len(pieces) <= 1:
        return [TaskSetArrived(hello=hello)]
    found = (RobotsFound(process=hello.process, statuses=tuple(piece)) for piece in pieces)
    return [TaskSetArrived(hello=hello, robots_follow=True), *found]


def arrived(tx: Transaction, command: TaskSetArrived) -> None:
    """Take a task set: adopt what runs there, note what is missing; ``Sync`` says the rest."""
    hello = command.hello
    _check_name(tx, hello)
    _register(tx, hello)
    running = {status.id: status for status in hello.endpoints}
    if not command.robots_follow:
        for status in hello.endpoints:
            _adopt(tx, hello.process, status)
    for endpoint in tx.tables.endpoints.by("task_set", hello.process):
        if endpoint.id not in running:
            _miss(tx, endpoint)
    for endpoint in tx.tables.endpoints.by("task_set", hello.process):
        # A task set ignores a spec that is older than what it has.
        if endpoint.id in running and running[endpoint.id].revision > endpoint.revision:
            tx.touch(endpoint.id)
    for status in hello.endpoints:
        if not _is_given(tx, status):
            _complain(tx, hello.process, status)
    volume_moves.found_again(tx, hello.process)
    tx.changes.arrived = hello.process
    placing.place_waiting(tx)


def robots_found(tx: Transaction, command: RobotsFound) -> None:
    """Take robots of a task set that has arrived, unless it was refused."""
    task_set = tx.tables.task_sets.get(command.process)
    if task_set is None or task_set.kind is not TaskSetKind.ROBOT:
        return
    for status in command.statuses:
        _adopt(tx, command.process, status)


def _check_name(tx: Transaction, hello: Hello) -> None:
    if not _PROCESS.fullmatch(hello.process):
        raise InvalidRequestError(
            f"{hello.process!r:.60} names no task set: it takes 1 to 255 characters and no blanks"
        )
    before = tx.tables.task_sets.get(hello.process)
    if before is not None and before.kind is not hello.kind:
        raise ConflictError(f"there is a {before.kind.value} task set {hello.process!r} already")


def _register(tx: Transaction, hello: Hello) -> None:
    before = tx.tables.task_sets.get(hello.process)
    tx.put(
        TaskSet(
            process=hello.process,
            kind=hello.kind,
            machine=hello.machine,
            url=hello.url,
            address=hello.address,
            bearer=hello.bearer,
            snapshots=SNAPSHOTS in hello.features,
        )
    )
    tx.put(Presence(process=hello.process, connected=True, since=tx.now))
    for tombstone in tx.tables.tombstones.by("process", hello.process):
        tx.delete(tx.tables.tombstones, tombstone.key)
    if before is not None and before.address != hello.address:
        for endpoint in tx.tables.endpoints.by("task_set", hello.process):
            if isinstance(endpoint, Robot):
                endpoints.touch_dialers(tx, endpoint.id)
    text = f"on {hello.machine.name}" + (f": {hello.machine.detail}" if hello.machine.detail else "")
    tx.happen("task_set_connected", hello.process, text, user="")


def _adopt(tx: Transaction, process: str, status: EndpointStatus) -> None:
    endpoint = tx.tables.endpoints.get(status.id)
    if isinstance(endpoint, Container) and not endpoint.task_set:
        _find_again(tx, process, endpoint, status)
        endpoint = tx.tables.endpoints[status.id]
    if endpoint is not None and endpoint.task_set == process:
        _note(tx, endpoint, status)


def _find_again(tx: Transaction, process: str, container: Container, status: EndpointStatus) -> None:
    """Let a container that is placed nowhere continue where it is, unless it grew too much meanwhile.

    It may not if its files, or the others of its group's network, are on another machine. One of the same
    name that was there before it is none of its lives: ``Sync`` has it dropped, and the container may be
    placed there when it is gone.
    """
    task_set = tx.tables.task_sets[process]
    if task_set.kind is not TaskSetKind.CONTAINER or status.state is EndpointState.STOPPING:
        return
    is_former = status.revision < container.born or not _is_given(tx, status)
    belongs_elsewhere = volumes.come_from_elsewhere(
        tx.tables, container, process
    ) or capacity.is_tied_elsewhere(tx.tables, container, process)
    if is_former or belongs_elsewhere:
        tx.put(Tombstone(process=process, id=container.id))
    elif not capacity.room_at(tx.tables, task_set).shortages(container.resources):
        volumes.end_move(tx, container)
        placing.bind(tx, container, process)


def _is_given(tx: Transaction, status: EndpointStatus) -> bool:
    """Tell whether this master, or one before it, can have given the revision that a task set reports."""
    return status.revision <= tx.newest("revision")


def _complain(tx: Transaction, process: str, status: EndpointStatus) -> None:
    """Tell the operator of a revision that no master gave, which counts for nothing."""
    text = (
        f"{process} reports revision {status.revision}, and the newest that was given is "
        f"{tx.newest('revision')}: not believed; if the clock of the master's machine was set back, "
        "make it right and restart the master"
    )
    tx.happen("revision_unknown", status.id, text, user="")


def _miss(tx: Transaction, endpoint: Container | Robot) -> None:
    if isinstance(endpoint, Container):
        containers.missing(tx, endpoint)
    else:
        robots.leave(tx, endpoint, "its task set does not have it any more")


def left(tx: Transaction, command: TaskSetLeft) -> None:
    """Note that a task set's channel ended: its robots become absent, its containers continue unseen."""
    process = command.process
    if not tx.tables.is_connected(process):
        return
    has_robots = tx.tables.task_sets[process].kind is TaskSetKind.ROBOT
    tx.put(Presence(process=process, connected=False, since=tx.now, leaving=has_robots))
    for tombstone in tx.tables.tombstones.by("process", process):
        tx.delete(tx.tables.tombstones, tombstone.key)
    for departure in list(tx.tables.departures.by("process", process)):
        tx.delete(tx.tables.departures, departure.id)
    draining.left(tx, process)
    tx.happen("task_set_left", process, user="")
    robots.leave_lost(tx)
    placing.place_waiting(tx)


def status_reported(tx: Transaction, command: StatusReported) -> None:
    """Apply a task set's report about one endpoint; ignore one that comes after the end of its channel."""
    if not tx.tables.is_connected(command.process):
        return
    endpoint = tx.tables.endpoints.get(command.status.id)
    move = tx.tables.moves.get(command.status.id)
    if endpoint is not None and endpoint.task_set == command.process:
        _note(tx, endpoint, command.status)
    elif move is not None and move.to == command.process:
        draining.reported(tx, move, command.status)
    else:
        _reported_elsewhere(tx, command.process, command.status)


def status_patched(tx: Transaction, command: StatusPatched) -> None:
    """Note what a task set reports as changed; if it does not fit what is known, ask for the whole."""
    process, patch = command.process, command.patch
    if not tx.tables.is_connected(process):
        return
    id_ = patch.status.id
    endpoint, move = tx.tables.endpoints.get(id_), tx.tables.moves.get(id_)
    if endpoint is not None and endpoint.task_set == process:
        if _follows(patch, tx.tables.live[id_].status):
            _note(tx, endpoint, patch.status, patch)
        else:
            tx.changes.wanted_statuses.append((process, id_))
    elif move is not None and move.to == process:
        if _follows(patch, move.status):
            draining.reported(tx, move, patch.status, patch)
        else:
            tx.changes.wanted_statuses.append((process, id_))
    else:
        _reported_elsewhere(tx, process, patch.status, patch)


def _reported_elsewhere(
    tx: Transaction, process: str, status: EndpointStatus, patch: StatusPatch | None = None
) -> None:
    """Apply a report about an endpoint by a task set where it is not placed."""
    if tx.tables.task_sets[process].kind is TaskSetKind.ROBOT:
        robots.reported_elsewhere(tx, process, status)
    else:
        handing_over.departing_reported(tx, process, status, patch)


def _follows(patch: StatusPatch, known: EndpointStatus | None) -> bool:
    return known is not None and patch.status.number == known.number + 1


def spec_requested(tx: Transaction, command: SpecRequested) -> None:
    """Send the whole spec of an endpoint to its task set again."""
    endpoint = tx.tables.endpoints.get(command.id)
    if endpoint is not None and endpoint.task_set == command.process:
        tx.changes.wanted_specs.append((command.process, command.id))


def _note(
    tx: Transaction, endpoint: Container | Robot, status: EndpointStatus, patch: StatusPatch | None = None
) -> None:
    header = without_wiring(status)
    if isinstance(endpoint, Robot) and (reason := robots.why_locked_out(tx.tables, endpoint)):
        robots.send_away(tx, endpoint, reason)
        return
    if isinstance(endpoint, Container):
        containers.reported(tx, endpoint, header)
    else:
        robots.reported(tx, endpoint, header)
    if tx.tables.live[endpoint.id].status is None:
        return
    if patch is None:
        activity.note(tx, status)
    else:
        activity.amend(tx, patch)


def gone(tx: Transaction, command: EndpointGone) -> None:
    """Note that an endpoint ended at a task set."""
    key = tombstone_key(command.process, command.id)
    handing_over.departed(tx, command.process, command.id)
    if key in tx.tables.tombstones:
        tx.delete(tx.tables.tombstones, key)
        if command.id not in tx.tables.endpoints:
            tx.happen("container_gone", command.id)
    else:
        _ended(tx, command)
    draining.advance(tx)
    placing.place_waiting(tx)


def _ended(tx: Transaction, command: EndpointGone) -> None:
    """Note that a task set ended what it was told to make."""
    endpoint = tx.tables.endpoints.get(command.id)
    move = tx.tables.moves.get(command.id)
    if isinstance(endpoint, Container) and endpoint.task_set == command.process:
        containers.ended(tx, endpoint)
    elif move is not None and move.to == command.process:
        draining.give_up(tx, move, "was ended there")


def fault(tx: Transaction, command: FaultReported) -> None:
    """Report a fault to the user of an endpoint."""
    user = command.id.partition("/")[0]
    if user not in tx.tables.users:
        raise NotFoundError(f"there is no user {user!r}")
    tx.notify(command.robot or user, command.text)
    tx.happen("fault", command.id, command.text)


def tick(tx: Transaction, _: Tick) -> None:
    """End expired grace times, place waiting containers, and notify users who have waited for long."""
    draining.begin_round(tx)
    _advance(tx)


def continue_work(tx: Transaction, _: Continue) -> None:
    """Do more of what a command left over."""
    _advance(tx)


def _advance(tx: Transaction) -> None:
    robots.send_away_locked_out(tx)
    robots.leave_lost(tx)
    robots.expire(tx)
    for presence in [one for one in tx.tables.presence if not one.connected]:
        _expire(tx, presence)
    draining.continue_round(tx)
    robots.empty_drained(tx)
    placing.place_waiting(tx)
    placing.tell_waiting(tx)


def _expire(tx: Transaction, presence: Presence) -> None:
    task_set = tx.tables.task_sets[presence.process]
    grace = tx.settings.container_grace if task_set.kind is TaskSetKind.CONTAINER else tx.settings.robot_grace
    if tx.now - presence.since < grace:
        return
    for endpoint in tx.tables.endpoints.by("task_set", presence.process):
        # One that moved together with a lost one is at its new place already.
        is_there = tx.tables.endpoints[endpoint.id].task_set == presence.process
        if isinstance(endpoint, Container) and is_there:
            if tx.is_out_of_work():
                return
            tx.spend(_LOSS)
            containers.lose(tx, endpoint)
    if not tx.tables.endpoints.count("task_set", presence.process):
        tx.delete(tx.tables.task_sets, presence.process)
        tx.delete(tx.tables.presence, presence.process)
        if task_set.kind is TaskSetKind.ROBOT and presence.process in tx.tables.drains:
            tx.delete(tx.tables.drains, presence.process)  # its next process has another name
        volume_moves.gone(tx, presence.process)
        tx.happen("task_set_gone", presence.process, f"away for {grace:.0f} s", user="")


def restarting(tx: Transaction, revision: int, piece: int) -> Iterator[None]:
    """Start with the store's contents: no task set is connected, and every grace time starts now.

    It pauses after so many endpoints.

    Revisions continue above ``revision``. Reports of task sets do not affect this: a revision that no master
    gave would stay in force as long as the store exists.
    """
    tx.raise_counter("revision", revision)
    tx.tables.first_revision = tx.newest("revision")
    for task_set in tx.tables.task_sets:
        tx.put(Presence(process=task_set.process, connected=False, since=tx.now))
    for number, endpoint in enumerate(tx.tables.endpoints, 1):
        tx.put(_restarted(tx, endpoint))
        if number % piece == 0:
            yield
    volume_moves.restart(tx)


def _restarted(tx: Transaction, endpoint: Container | Robot) -> ContainerLive | RobotLive:
    if isinstance(endpoint, Robot):
        return RobotLive(id=endpoint.id, session=RobotSession.ABSENT, since=tx.now)
    phase = ContainerPhase.PLACED if endpoint.task_set else ContainerPhase.REQUESTED
    return ContainerLive(id=endpoint.id, phase=phase, since=tx.now)
