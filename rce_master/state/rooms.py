"""The room on each machine, kept up to date with every write to the tables.

Counting the containers of all machines for each request would cost as much as there are containers. Here a
write changes the sums of the machines that it concerns, and the room of each of them is made again when it is
next asked for. The machines that may take containers are in the order of their load, so that a container is
compared with some of the least loaded ones, and not with all.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from typing import TYPE_CHECKING, NamedTuple

from rce.control import TaskSetKind
from rce.model import Resources
from rce_master.state.placement import Room
from rce_master.state.promises import Promises
from rce_master.state.records import Container

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

    from rce_master.state.records import Drain, Endpoint, Move, Presence, TaskSet
    from rce_master.state.table import Table
    from rce_master.state.volume_records import VolumeMove

CANDIDATES = 16
"""So many machines that would take a container are compared for it, the least loaded ones."""
_PAIR = 2
_ONE_MORE = Resources()
"""The container with which machines are put in order: most containers ask for no more than a slot."""


class Candidates(NamedTuple):
    """Machines that would take a container."""

    rooms: list[Room]
    looks: int
    """How many machines were looked at."""


class Offer(NamedTuple):
    """What all machines have together."""

    slots: int
    cores: int
    memory: int
    """Bytes."""


class _Order:
    """Open machines in the order of their load, the least loaded first.

    Args:
        loads: By process.
    """

    def __init__(self, loads: Mapping[str, float]) -> None:
        self._loads = dict(loads)
        self._sorted = sorted((load, process) for process, load in loads.items())

    def __contains__(self, process: str) -> bool:
        return process in self._loads

    def __len__(self) -> int:
        return len(self._sorted)

    def __iter__(self) -> Iterator[str]:
        return (process for _, process in self._sorted)

    def put(self, process: str, load: float | None) -> None:
        """Note the load of a machine; None: it is not open."""
        before = self._loads.pop(process, None)
        if before is not None:
            del self._sorted[bisect_left(self._sorted, (before, process))]
        if load is not None:
            self._loads[process] = load
            insort(self._sorted, (load, process))

    def of(self, among: Iterable[str]) -> _Order:
        """Return the order of some of the machines."""
        return _Order({process: self._loads[process] for process in among if process in self._loads})


class Rooms:
    """The rooms of all container machines, and what is promised to users.

    - A machine is *open* while it is connected and not draining. Only open machines are in the order.
    - What moves to a machine is promised there too.

    Args:
        endpoints: The containers.
        moves: The containers that move.
        volume_moves: Those that move with volumes.
        task_sets: The machines; with the index ``machine`` of container machines by the machine's name.
        presence: Which are connected.
        drains: Which are being drained.
        on_gain: Called with the process of a machine that may have more room than before.
    """

    def __init__(
        self,
        *,
        endpoints: Table[Endpoint],
        moves: Table[Move],
        volume_moves: Table[VolumeMove],
        task_sets: Table[TaskSet],
        presence: Table[Presence],
        drains: Table[Drain],
        on_gain: Callable[[str], None],
    ) -> None:
        self._endpoints = endpoints
        self._moves = moves
        self._volume_moves = volume_moves
        self._task_sets = task_sets
        self._presence = presence
        self._drains = drains
        self._on_gain = on_gain
        self._promises = Promises()
        self._of_users: dict[str, dict[str, int]] = {}
        self._rooms: dict[str, Room] = {}
        self._order = _Order({})
        self._among: Collection[str] | None = None
        """Of which machines the order was asked for last: as a rule those that are offered in a pass."""
        self._part: frozenset[str] = frozenset()
        self._part_order = _Order({})
        self._draining: dict[str, None] = {}
        self._stale: dict[str, None] = {}
        self._offered: Offer | None = None
        endpoints.watch(self._endpoint_changed)
        moves.watch(self._move_changed)
        volume_moves.watch(self._move_changed)
        task_sets.watch(self._task_set_changed)
        presence.watch(self._presence_changed)
        drains.watch(self._drain_changed)

    # Reading

    def __iter__(self) -> Iterator[Room]:
        """Iterate over the machines that are connected, or may still come back."""
        return iter(self._fresh().values())

    def get(self, process: str) -> Room | None:
        """Find a machine by the process name of its task set."""
        return self._fresh().get(process)

    @property
    def connected(self) -> list[Room]:
        """The connected machines."""
        return [room for process, room in self._fresh().items() if self._is_connected(process)]

    @property
    def away(self) -> list[Room]:
        """The machines that may still come back."""
        return [room for process, room in self._fresh().items() if not self._is_connected(process)]

    @property
    def is_any_connected(self) -> bool:
        """Whether any machine is connected."""
        self._fresh()
        return bool(self._order or self._draining)

    @property
    def draining(self) -> list[str]:
        """The processes of the connected machines that are draining."""
        self._fresh()
        return list(self._draining)

    @property
    def offered(self) -> Offer:
        """What all machines have together that are connected, or may still come back."""
        if self._offered is None:
            machines = [room.machine for room in self._fresh().values()]
            self._offered = Offer(
                slots=sum(machine.slots for machine in machines),
                cores=sum(machine.cores for machine in machines),
                memory=sum(machine.memory for machine in machines),
            )
        return self._offered

    @property
    def order(self) -> list[str]:
        """The processes of the open machines, the least loaded first."""
        self._fresh()
        return list(self._order)

    @property
    def promises(self) -> Promises:
        """What is promised on each machine, to read from."""
        return self._promises

    def of_user(self, user: str) -> Mapping[str, int]:
        """Count a user's placed containers by process."""
        return self._of_users.get(user, {})

    def candidates(
        self,
        requested: Resources,
        admits: Callable[[str], bool],
        *,
        among: Collection[str] | None = None,
        near: Iterable[str] = (),
        most: int = CANDIDATES,
    ) -> Candidates:
        """Return open machines that take a container, the least loaded ones.

        With at most ``most`` open machines, these are all that take it.

        Args:
            requested: What the container asks for.
            admits: Tells whether the machine of a process may be taken.
            among: Only these processes; None: all. Many are put in order once: they must not change.
            near: Processes that are returned too, whatever their load is.
            most: So many, and those of ``near``.
        """
        rooms = self._fresh()
        found: dict[str, Room] = {}
        looks = 0
        for process in self._in_order(among):
            looks += 1
            room = rooms[process]
            if room.fits(requested) and admits(process):
                found[process] = room
                if len(found) >= most:
                    break
        for process in near:
            if process in found or process not in self._order:
                continue
            if among is not None and process not in among:
                continue
            looks += 1
            if rooms[process].fits(requested) and admits(process):
                found[process] = rooms[process]
        return Candidates(list(found.values()), looks)

    def _in_order(self, among: Collection[str] | None) -> Iterable[str]:
        """Return the processes of open machines, the least loaded first."""
        if among is None:
            return self._order
        if len(among) <= CANDIDATES:
            return self._order.of(among)
        if among is not self._among:
            self._among, self._part, self._part_order = among, frozenset(among), self._order.of(among)
        return self._part_order

    # Following the tables

    def _endpoint_changed(self, before: Endpoint | None, after: Endpoint | None) -> None:
        was = before if isinstance(before, Container) else None
        now = after if isinstance(after, Container) else None
        if was and now and (was.task_set, was.resources) == (now.task_set, now.resources):
            return
        known = was or now
        if known is None:
            return
        if was is not None and was.task_set:
            self._leave(was.task_set, was)
            self._count(was.user, was.task_set, -1)
        if now is not None and now.task_set:
            self._enter(now.task_set, now)
            self._count(now.user, now.task_set, 1)
        move = self._moves.get(known.id) or self._volume_moves.get(known.id)
        if move is not None and move.to:
            if was is not None:
                self._leave(move.to, was)
            if now is not None:
                self._enter(move.to, now)

    def _move_changed(self, before: Move | VolumeMove | None, after: Move | VolumeMove | None) -> None:
        if before is not None and after is not None and before.to == after.to:
            return
        known = before or after
        container = self._endpoints.get(known.id) if known is not None else None
        if not isinstance(container, Container):
            return
        if before is not None and before.to:
            self._leave(before.to, container)
        if after is not None and after.to:
            self._enter(after.to, container)

    def _task_set_changed(self, before: TaskSet | None, after: TaskSet | None) -> None:
        names = [_machine_name(before), _machine_name(after)]
        if names[0] != names[1]:
            for name in names:
                # From the second one on a machine on, all are called by their processes, and not by its name.
                if name is not None and self._task_sets.count("machine", name) <= _PAIR:
                    for other in self._task_sets.by("machine", name):
                        self._touch(other.process)
        self._offered = None
        known = after or before
        if known is not None:
            self._stale[known.process] = None
            self._on_gain(known.process)

    def _presence_changed(self, before: Presence | None, after: Presence | None) -> None:
        known = after or before
        if known is not None and (before is None or after is None or before.connected != after.connected):
            self._touch(known.process)
            self._on_gain(known.process)

    def _drain_changed(self, before: Drain | None, after: Drain | None) -> None:
        known = after or before
        if known is not None:
            self._touch(known.process)
            self._on_gain(known.process)

    def _enter(self, process: str, container: Container) -> None:
        self._promises.add(process, container.resources)
        self._touch(process)

    def _leave(self, process: str, container: Container) -> None:
        self._promises.remove(process, container.resources)
        self._touch(process)
        self._on_gain(process)

    def _count(self, user: str, process: str, sign: int) -> None:
        counts = self._of_users.setdefault(user, {})
        counts[process] = counts.get(process, 0) + sign
        if not counts[process]:
            del counts[process]
            if not counts:
                del self._of_users[user]

    def _touch(self, process: str) -> None:
        if process in self._task_sets:
            self._stale[process] = None

    # Making rooms

    def _fresh(self) -> dict[str, Room]:
        """Make the rooms that changed, and return all."""
        if self._stale:
            stale, self._stale = self._stale, {}
            for process in stale:
                self._make(process)
        return self._rooms

    def _make(self, process: str) -> None:
        self._draining.pop(process, None)
        task_set = self._task_sets.get(process)
        if task_set is None or task_set.kind is not TaskSetKind.CONTAINER:
            self._rooms.pop(process, None)
            self._put(process, None)
            return
        room = self._rooms[process] = self._room(task_set)
        is_connected = self._is_connected(process)
        self._put(process, room.load_with(_ONE_MORE) if is_connected and not room.draining else None)
        if is_connected and room.draining:
            self._draining[process] = None

    def _put(self, process: str, load: float | None) -> None:
        self._order.put(process, load)
        if process in self._part:
            self._part_order.put(process, load)

    def _room(self, task_set: TaskSet) -> Room:
        process, machine = task_set.process, task_set.machine
        promise = self._promises.sum_of(process)
        has_namesakes = self._task_sets.count("machine", machine.name) > 1
        return Room(
            process=process,
            machine=machine,
            alias=process if has_namesakes else "",
            draining=machine.draining or process in self._drains,
            slots=promise.slots,
            cpu=promise.cpu,
            memory=promise.memory_of(machine.memory // machine.slots if machine.slots else 0),
            containers=promise.containers,
        )

    def _is_connected(self, process: str) -> bool:
        presence = self._presence.get(process)
        return presence is not None and presence.connected


def _machine_name(task_set: TaskSet | None) -> str | None:
    return task_set.machine.name if task_set is not None and task_set.kind is TaskSetKind.CONTAINER else None
