"""Draining of machines: they take no new containers and robots, and hand over those that they have.

The robots of a drained robot task set are disconnected, and connect again at another one
(:func:`rce_master.state.robots.empty_drained`).

An operator may have a single container handed over, too.

A container is *handed over* by a move: a copy of it, with its nodes and parameters but without interfaces and
connections, is made at another machine while the container continues; once the copy's nodes are up, the copy
makes its links, becomes the container, and the former one gives its last answers
(:mod:`rce_master.state.handing_over`). A node that is not
up in the container need not be up in the copy: a node without ROS never registers. A container with volumes
is ended first, and moves with its files (:mod:`rce_master.state.volume_moves`). One container at a time
moves away from a machine; those in the network of one group move together. A container without room elsewhere
stays where it is, and is tried again at every tick.

A drain outlives a restart of the master, and so does a move with volumes. Another move does not: the copy is
dropped, and the move starts again if the machine is draining.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec.structs import replace

from rce.control import EndpointState, EndpointStatus, NodeState, TaskSetKind, without_wiring
from rce_master.exceptions import ConflictError, NoRoomError, NotFoundError
from rce_master.state import activity, capacity, endpoints, handing_over, placing, robots, volume_moves
from rce_master.state.lifecycle import ContainerEvent
from rce_master.state.placement import Room, best_of, refusals
from rce_master.state.records import Container, Drain, Move

if TYPE_CHECKING:
    from collections.abc import Collection

    from rce.control import StatusPatch
    from rce.model import Resources
    from rce_master.state.changes import Transaction
    from rce_master.state.commands import MoveContainer, SetDraining
    from rce_master.state.tables import Tables

_NOT_YET = frozenset({NodeState.WAITING, NodeState.STARTING})
_UP = frozenset({NodeState.RUNNING, NodeState.EXITED})
_LOOK = 10
"""The work of looking at a container, as :attr:`StateSettings.max_work` counts it; and of a move."""
_MOVE = 100


def set_draining(tx: Transaction, command: SetDraining) -> None:
    """Drain a machine or a task set, or cancel that; without effect if it is already so."""
    for process in _drained(tx.tables, command.machine):
        if command.draining == (process in tx.tables.drains):
            continue
        if command.draining:
            tx.put(Drain(process=process))
            tx.happen("machine_draining", process, user="")
        else:
            tx.delete(tx.tables.drains, process)
            _call_back(tx, process)
            tx.happen("machine_undrained", process, user="")
    advance(tx)
    robots.empty_drained(tx)
    placing.place_waiting(tx)


def move_container(tx: Transaction, command: MoveContainer) -> None:
    """Begin to hand a container over to a machine, with those that move together with it.

    Raises:
        NotFoundError: The container or the machine does not exist.
        ConflictError: The container is not at a machine yet, is there already, or moves already.
        NoRoomError: The machine does not take it.
    """
    tables = tx.tables
    container = tables.container(f"{command.user}/{command.tag}")
    if container is None:
        raise NotFoundError(f"there is no container {command.tag!r}")
    processes = _processes(tables, command.machine)
    unit = _unit(tables, container)
    if not container.task_set:
        raise ConflictError(f"container {command.tag!r} waits for a machine; rce ps shows why")
    if container.task_set in processes:
        raise ConflictError(f"container {command.tag!r} is at {command.machine} already")
    if (to := next((to for each in unit if (to := _moves_to(tables, each))), "")) != "":
        raise ConflictError(f"container {command.tag!r} moves to {to} already")
    search = _Search(tx)
    target = search.target(unit, processes)
    if not target:
        raise NoRoomError(f"container {command.tag!r} stays: {search.obstacle(unit, processes)}")
    for each in unit:
        _begin(tx, each, target)


def _moves_to(tables: Tables, container: Container) -> str:
    """Return where a container is being moved to; empty if it is not."""
    move = tables.moves.get(container.id) or tables.volume_moves.get(container.id)
    return "" if move is None else move.to


def _processes(tables: Tables, name: str) -> list[str]:
    """Find the container task sets of a machine, by its name or that of a task set."""
    found = [
        s.process
        for s in tables.task_sets
        if s.kind is TaskSetKind.CONTAINER and name in (s.process, s.machine.name)
    ]
    if not found:
        raise NotFoundError(f"there is no container machine {name!r}; rce machines lists them")
    return found


def _drained(tables: Tables, name: str) -> list[str]:
    """Find the task sets that a drain concerns: those of a machine, or the one of this name."""
    found = [s.process for s in tables.task_sets if name in (s.process, s.machine.name)]
    if name in tables.drains and name not in found:
        found.append(name)
    if not found:
        raise NotFoundError(f"there is no machine or task set {name!r}; rce machines lists them")
    return found


def advance(tx: Transaction) -> None:
    """Begin the next move from each machine that is draining, and give up moves that take too long."""
    begin_round(tx)
    continue_round(tx)


def begin_round(tx: Transaction) -> None:
    """Note that all machines that are draining have to be looked at."""
    for process in tx.tables.rooms.draining:
        tx.tables.drain_round.setdefault(process, 0)


def continue_round(tx: Transaction) -> None:
    """Look at as many machines that are draining as a command may."""
    for move in list(tx.tables.moves):
        if tx.now - move.since >= tx.settings.move_timeout:
            if tx.is_out_of_work():
                return
            tx.spend(_MOVE)
            give_up(tx, move, f"did not come up there within {tx.settings.move_timeout:.0f} s")
    volume_moves.expire(tx)
    handing_over.expire(tx)
    for id_ in [move.id for move in tx.tables.moves]:
        _proceed(tx, id_)
    waiting, draining = tx.tables.drain_round, set(tx.tables.rooms.draining)
    search = _Search(tx)
    while waiting and not tx.is_out_of_work():
        process = next(iter(waiting))
        if process not in draining or _advance(tx, process, search):
            del waiting[process]


def _advance(tx: Transaction, process: str, search: _Search) -> bool:
    """Begin the next move from a machine; return whether it is done with, for now."""
    here = [e for e in tx.tables.endpoints.by("task_set", process) if isinstance(e, Container)]
    if any(_moves_to(tx.tables, container) for container in here):
        return True
    reached = tx.tables.drain_round[process]
    for container in sorted((one for one in here if one.number > reached), key=lambda c: c.number):
        if tx.now < tx.tables.container_live(container.id).rest_until:
            continue
        if tx.is_out_of_work():
            return False
        tx.spend(_LOOK)
        unit = _unit(tx.tables, container)
        target = search.target(unit)
        if target:
            tx.spend(_MOVE * len(unit))
            for each in unit:
                _begin(tx, each, target)
            return True
        _stay(tx, container, search.obstacle(unit))
        tx.tables.drain_round[process] = container.number
    return True


class _Search:
    """Finds machines for containers that are to move; remembers what no machine takes.

    Rooms only fill up meanwhile: what found none finds none later.
    """

    def __init__(self, tx: Transaction) -> None:
        self._tx = tx
        self._too_much: set[Resources] = set()
        self._texts: dict[tuple[str, Resources], str] = {}

    def target(self, unit: list[Container], among: Collection[str] | None = None) -> str:
        """Return a machine that takes all of some containers; empty if none does.

        Args:
            unit: The containers.
            among: Only the machines of these processes; None: all.
        """
        tx, first = self._tx, unit[0]
        requested, tables = first.resources, tx.tables
        if requested in self._too_much:
            return ""

        def admits(process: str) -> bool:
            return all(capacity.admission(tables, each, moves=True)(process) for each in unit) and _takes_all(
                tables.rooms.get(process), unit
            )

        if any(each.resources.volumes and volume_moves.why_not(tables, each) for each in unit):
            return ""
        company = capacity.company(tables, first)
        near = company if among is None else company.keys() & set(among)
        found = tables.rooms.candidates(requested, admits, among=among, near=near)
        tx.spend(found.looks)
        takes_none = among is None and not found.rooms
        if takes_none and not tables.rooms.candidates(requested, lambda _: True, most=1).rooms:
            self._too_much.add(requested)
        room = best_of(found.rooms, requested, company=company, own=tables.rooms.of_user(first.user))
        return room.process if room is not None else ""

    def obstacle(self, unit: list[Container], among: Collection[str] | None = None) -> str:
        """Report why containers cannot be handed over; the arguments are those of :meth:`target`."""
        tables, first = self._tx.tables, unit[0]
        with_volumes = [each for each in unit if each.resources.volumes]
        if why := next((why for each in with_volumes if (why := volume_moves.why_not(tables, each))), ""):
            return why
        mates = len(unit) - 1
        whole = f"it moves with {mates} others of its group; " if mates else ""
        key = (first.task_set, first.resources)
        if key not in self._texts:
            rooms = [
                room
                for room in tables.rooms.connected
                if room.process != first.task_set and (among is None or room.process in among)
            ]
            self._tx.spend(len(rooms))
            none = "there is no other machine" if among is None else "that machine is away"
            self._texts[key] = refusals(rooms, first.resources) if rooms else none
        ending = "it is about to move" if among is None else "a container of its name is still ending there"
        if with_volumes:
            ending = "its former files are still being removed there, or that machine runs an earlier release"
        said = "no machine has room for all of them" if mates else ending
        return whole + (self._texts[key] or said)


def _takes_all(room: Room | None, unit: list[Container]) -> bool:
    """Whether a machine has room for all of some containers together."""
    if room is None:
        return False
    for each in unit:
        if not room.fits(each.resources):
            return False
        if len(unit) > 1:
            room = room.with_(each.resources)
    return True


def _unit(tables: Tables, container: Container) -> list[Container]:
    """Return the containers that move together with a container, itself first."""
    mates = capacity.group_mates(tables, container)
    return [container, *(mate for mate in mates if mate.task_set == container.task_set)]


def _begin(tx: Transaction, container: Container, to: str) -> None:
    if container.resources.volumes:
        volume_moves.begin(tx, container, to)
        return
    tx.put(Move(id=container.id, to=to, epoch=endpoints.new_epoch(tx), since=tx.now))
    tx.put(replace(tx.tables.container_live(container.id), stays=""))
    tx.touch(container.id)
    tx.happen("container_moving", container.id, f"from {container.task_set} to {to}")


def _stay(tx: Transaction, container: Container, why: str) -> None:
    live = tx.tables.container_live(container.id)
    if live.stays != why:
        tx.put(replace(live, stays=why))
        draining = ", which is draining" if _is_draining(tx, container) else ""
        tx.happen("container_stays", container.id, f"at {container.task_set}{draining}: {why}", user="")


def _is_draining(tx: Transaction, container: Container) -> bool:
    return container.task_set in tx.tables.rooms.draining


# Progress of moves


def reported(tx: Transaction, move: Move, status: EndpointStatus, patch: StatusPatch | None = None) -> None:
    """Apply a report about a container's copy, or a patch of one."""
    if status.state is EndpointState.FAILED:
        give_up(tx, move, f"failed there: {status.detail or 'no reason was given'}")
        return
    connections = handing_over.established(move, status, patch)
    tx.put(replace(move, status=without_wiring(status), connections=connections))
    if _proceed(tx, move.id):
        advance(tx)


def _proceed(tx: Transaction, id_: str) -> bool:
    """Let copies make their links, or take over, if they can; return whether they took over."""
    container = tx.tables.container(id_)
    if container is None or id_ not in tx.tables.moves:
        return False
    unit = _unit(tx.tables, container)
    if not _bring_along(tx, tx.tables.moves[id_], unit):
        return False
    moves = [tx.tables.moves[each.id] for each in unit]
    company = frozenset(m.id for m in moves)
    if not all(_is_ready(tx, m) for m in moves):
        return False
    late = [m for m in moves if m.linking_since is None]
    if late and any(handing_over.in_use(tx.tables, m.id, company) for m in moves):
        if handing_over.may_link(tx.tables, company):
            for m in late:
                handing_over.begin_links(tx, m)
        return False
    if not late and not all(handing_over.has_links(tx, m, company) for m in moves):
        return False
    for m in moves:
        _switch(tx, m, company)
    return True


def _bring_along(tx: Transaction, move: Move, unit: list[Container]) -> bool:
    """Begin the moves of those that joined the group later; return whether all of a unit move already."""
    tables = tx.tables
    late = [each for each in unit if each.id not in tables.moves]
    for each in late:
        why = volume_moves.why_not(tables, each) if each.resources.volumes else ""
        if not why and not capacity.admission(tables, each)(move.to):
            why = "a container of its name is still ending there"
        if not why and not _takes_all(tables.rooms.get(move.to), late):
            why = "the machine lacks room"
        if why:
            give_up(tx, move, f"cannot move without container {each.tag!r}, which joined its group: {why}")
            return False
    for each in late:
        _begin(tx, each, move.to)
    return not late


def _is_ready(tx: Transaction, move: Move) -> bool:
    """Whether the copy's nodes are up, as far as those of the container are."""
    status, former = move.status, tx.tables.container_live(move.id).status
    if status is None or status.revision <= 0:  # without its spec it reports no nodes
        return False
    no_further = {n.tag for n in former.nodes if n.state not in _UP} if former is not None else set()
    if any(node.state in _NOT_YET and node.tag not in no_further for node in status.nodes):
        return False
    if status.state is EndpointState.DEGRADED:
        return former is None or former.state is not EndpointState.RUNNING
    return status.state is EndpointState.RUNNING


def _switch(tx: Transaction, move: Move, company: frozenset[str]) -> None:
    container = tx.tables.container(move.id)
    assert container is not None
    assert move.status is not None
    handing_over.depart(tx, container, handing_over.in_use(tx.tables, move.id, company))
    tx.delete(tx.tables.moves, move.id)
    _settle(tx, container, move)
    tx.put(replace(tx.tables.container_live(move.id), status=move.status))
    tx.changes.wanted_statuses.append((move.to, move.id))
    placing.happened(tx, move.id, _PHASES[move.status.state])
    tx.happen("container_moved", move.id, f"from {container.task_set} to {move.to}")


_PHASES = {EndpointState.RUNNING: ContainerEvent.RUNNING, EndpointState.DEGRADED: ContainerEvent.DEGRADED}


def _settle(tx: Transaction, container: Container, move: Move) -> None:
    if move.status is not None:
        container = replace(container, address=move.status.address)
    endpoints.assign(tx, container, move.to, epoch=move.epoch)
    endpoints.touch_dialers(tx, move.id)
    placing.happened(tx, move.id, ContainerEvent.PLACE)


def promote(tx: Transaction, container: Container) -> bool:
    """Let a container's copy take over at once, because the container itself has ended.

    The copies of those that move together with it take over, too.

    Returns:
        Whether a copy exists. One whose company has no copies yet is dropped.
    """
    move = tx.tables.moves.get(container.id)
    if move is None:
        return False
    unit = _unit(tx.tables, container)
    if any(each.id not in tx.tables.moves for each in unit):
        give_up(tx, move, "ended before all of its group had copies there")
        return False
    for each in unit:
        move = tx.tables.moves[each.id]
        if each.id != container.id:
            handing_over.depart(tx, each, frozenset())
        tx.delete(tx.tables.moves, each.id)
        _settle(tx, each, move)
        tx.put(replace(tx.tables.container_live(each.id), status=None))
        activity.forget(tx, each.id)
        tx.happen("container_moved", each.id, f"to {move.to}, before it was up there")
    return True


def give_up(tx: Transaction, move: Move, why: str) -> None:
    """End a move: the container stays where it is for now, and its copy is dropped.

    So do those that move together with it. Without effect if the move has ended already.
    """
    container = tx.tables.container(move.id)
    if container is None or move.id not in tx.tables.moves:
        return
    again = f"; tried again in {tx.settings.move_rest:.0f} s" if _is_draining(tx, container) else ""
    for each in _unit(tx.tables, container):
        endpoints.drop_copy(tx, each.id, "the move was given up")
        live = tx.tables.container_live(each.id)
        tx.put(replace(live, rest_until=tx.now + tx.settings.move_rest))
        whose = "it" if each.id == container.id else f"container {container.tag!r} of its group"
        _stay(tx, each, f"{move.to}: {whose} {why}{again}")


def left(tx: Transaction, process: str) -> None:
    """End the moves to a task set that disconnected; it drops its copies when it comes back."""
    for move in list(tx.tables.moves.by("to", process)):
        give_up(tx, move, "went away")
    volume_moves.left(tx, process)


def _call_back(tx: Transaction, process: str) -> None:
    """End the moves away from a machine that is not drained any more."""
    for container in tx.tables.endpoints.by("task_set", process):
        endpoints.drop_copy(tx, container.id, "its machine is not drained any more")
        if isinstance(container, Container):
            volume_moves.call_back(tx, container)
            tx.put(replace(tx.tables.container_live(container.id), stays=""))
