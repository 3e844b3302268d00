"""Where a container fits, and where it fits best. Pure: knows machines and promises, not the state's tables.

A machine is *full* for a container when what was promised to the containers there, and what this one asks
for, is more than it has of slots, cores or memory. What a container does not ask for explicitly is not
promised, but memory: there it counts with as many slots' shares as its size.

Among the machines with room, the one is taken that is left least loaded in what it is shortest of. Beside
that, containers that belong together are put together: a machine with more of the container's company (what
it is joined with, the others of its group) is preferred as long as its load is not larger by :data:`DETOUR`.
Of equals, the one with more containers of the same user is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rce.model import MEGABYTE, Network, Resources, write_cores

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rce.control import MachineInfo

DETOUR = 0.2
"""So much more of a machine may be in use, as a share of it, for the sake of a container's company."""
CROWD = 16
"""Where slots are not counted, so many containers for each core count as a full load (but are no limit)."""
PODMAN = "podman"
_TINY = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Need:
    """What a container takes of a machine."""

    slots: int
    cpu: float
    """Cores."""
    memory: int
    """Bytes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """A machine and what was promised there."""

    process: str
    """Of its task set."""
    machine: MachineInfo
    alias: str = ""
    """What people call it, if that is not the machine's name."""
    draining: bool = False
    slots: int = 0
    cpu: float = 0.0
    memory: int = 0
    containers: int = 0

    @property
    def name(self) -> str:
        """What people call it."""
        return self.alias or self.machine.name

    def filled(self, all_requested: Iterable[Resources]) -> Room:
        """Tell what it is like with more containers; as :meth:`with_` for each, but quick for many."""
        slots = memory = containers = 0
        cpu, share = 0.0, self._share
        for requested in all_requested:
            size = max(1, requested.size)
            slots += size
            cpu += requested.cpu
            memory += requested.memory or size * share
            containers += 1
        return replace(
            self,
            slots=self.slots + slots,
            cpu=self.cpu + cpu,
            memory=self.memory + memory,
            containers=self.containers + containers,
        )

    @property
    def _share(self) -> int:
        """A slot's share of the memory, in bytes."""
        return self.machine.memory // self.machine.slots if self.machine.slots else 0

    def need(self, requested: Resources) -> Need:
        """Tell what a container takes here."""
        slots = max(1, requested.size)
        return Need(slots=slots, cpu=requested.cpu, memory=requested.memory or slots * self._share)

    def with_(self, requested: Resources) -> Room:
        """Tell what it is like with one more container."""
        return self._changed(requested, 1)

    def without(self, requested: Resources) -> Room:
        """Tell what it is like with one container less."""
        return self._changed(requested, -1)

    def _changed(self, requested: Resources, sign: int) -> Room:
        need = self.need(requested)
        return replace(
            self,
            slots=self.slots + sign * need.slots,
            cpu=self.cpu + sign * need.cpu,
            memory=self.memory + sign * need.memory,
            containers=self.containers + sign,
        )

    def obstacles(self, requested: Resources) -> list[str]:
        """Tell why it would not take a container even if it were empty; nothing if it would."""
        machine = self.machine
        found = [
            f"lacks the label {label}" for label in requested.special_features if label not in machine.labels
        ]
        if requested.network is not Network.NONE and requested.network.value not in machine.networks:
            found.append(f"has no network {requested.network.value}")
        if requested.image and PODMAN not in (machine.runtime, *machine.runtimes):
            found.append(f"has no {PODMAN} for the image {requested.image}")
        if requested.volumes and not machine.volumes:
            found.append("has no volumes (its container task set is of an earlier release)")
        if self.draining:
            found.append("is draining")
        return found

    def shortages(self, requested: Resources, had: Resources | None = None) -> list[str]:
        """Tell what it has too little of for a container; nothing if it has enough.

        Args:
            requested: What the container asks for.
            had: What it has been promised before, and is not counted here: of what it asks for no more of
                than that, there is enough in any case.
        """
        need, before = self.need(requested), self.need(had) if had is not None else None
        machine, found = self.machine, []
        if machine.slots and (before is None or need.slots > before.slots):
            free = machine.slots - self.slots
            if need.slots > free:
                found.append(f"has {max(0, free)} of {machine.slots} slots free, {need.slots} needed")
        if machine.cores and (before is None or need.cpu > before.cpu):
            cores = machine.cores - self.cpu
            if need.cpu > cores + _TINY:
                texts = [write_cores(max(0.0, value)) for value in (cores, machine.cores, need.cpu)]
                found.append("has {} of {} cores free, {} needed".format(*texts))
        if machine.memory and (before is None or need.memory > before.memory):
            memory = machine.memory - self.memory
            if need.memory > memory:
                texts = [f"{max(0, value) // MEGABYTE}" for value in (memory, machine.memory)]
                needed = -(-need.memory // MEGABYTE)
                found.append("has {} of {} MB memory free, {} MB needed".format(*texts, needed))
        return found

    def fits(self, requested: Resources) -> bool:
        """Whether it takes a container now."""
        machine, slots = self.machine, max(1, requested.size)
        # The same as :meth:`shortages`, without texts: this is asked of many machines for each container.
        if machine.slots and slots > machine.slots - self.slots:
            return False
        if machine.cores and requested.cpu > machine.cores - self.cpu + _TINY:
            return False
        if machine.memory and (requested.memory or slots * self._share) > machine.memory - self.memory:
            return False
        is_plain = not (requested.special_features or requested.image or requested.volumes)
        if is_plain and requested.network is Network.NONE:
            return not self.draining
        return not self.obstacles(requested)

    def why_not(self, requested: Resources) -> str:
        """Say why it does not take a container now; empty if it does."""
        reasons = self.obstacles(requested) or self.shortages(requested)
        return f"{self.name} {' and '.join(reasons)}" if reasons else ""

    @property
    def shares(self) -> dict[str, float]:
        """How much of each thing that is counted is promised, 1 for all of it."""
        machine = self.machine
        counted = {
            "slots": (self.slots, machine.slots),
            "cores": (self.cpu, machine.cores),
            "memory": (self.memory, machine.memory),
        }
        return {name: used / there for name, (used, there) in counted.items() if there}

    @property
    def load(self) -> float:
        """How much is promised of what it is shortest of."""
        return self._load(self.slots, self.cpu, self.memory, self.containers)

    def load_with(self, requested: Resources) -> float:
        """Return the load with one more container; as that of :meth:`with_`, but quick."""
        slots = max(1, requested.size)
        memory = requested.memory or slots * self._share
        return self._load(
            self.slots + slots, self.cpu + requested.cpu, self.memory + memory, self.containers + 1
        )

    def _load(self, slots: int, cpu: float, memory: int, containers: int) -> float:
        machine = self.machine
        load = 0.0
        if machine.slots:
            load = slots / machine.slots
        elif containers:
            load = containers / (CROWD * max(1, machine.cores))
        if machine.cores:
            load = max(load, cpu / machine.cores)
        if machine.memory:
            load = max(load, memory / machine.memory)
        return load


def best_of(
    rooms: Iterable[Room],
    requested: Resources,
    *,
    company: Mapping[str, int] | None = None,
    own: Mapping[str, int] | None = None,
) -> Room | None:
    """Choose the machine for a container.

    Args:
        rooms: The machines that take it.
        requested: What the container asks for.
        company: How much of what belongs together with it is where, by process.
        own: How many other containers of its user are where, by process.

    Returns:
        The best; None without any room.
    """
    fitting = list(rooms)
    if not fitting:
        return None
    loads = {room.process: room.load_with(requested) for room in fitting}
    near = min(loads.values()) + DETOUR + _TINY
    company, own = company or {}, own or {}

    def rank(room: Room) -> tuple[float, float, int, str]:
        load = round(loads[room.process], 6)
        together = company.get(room.process, 0) if load <= near else 0
        return -together, load, -own.get(room.process, 0), room.process

    return min(fitting, key=rank)


def refusals(rooms: Iterable[Room], requested: Resources, *, most: int = 8) -> str:
    """Say of the first few machines why they do not take a container, and how many more do not."""
    found: list[str] = []
    more = 0
    for room in rooms:
        if len(found) < most:
            if text := room.why_not(requested):
                found.append(text)
        elif not room.fits(requested):
            more += 1
    return "; ".join(found) + (f"; and {more} more machines" if more else "")
