"""What limits are, and what every way to enforce them offers.

A container has one *cell*: the place in which the machine counts and limits all of its processes together.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import ClassVar, NamedTuple, Protocol

from rce.control.machine import MEGABYTE, MIN_MEMORY
from rce.model.specs import Resources


class Limits(NamedTuple):
    """What a container may use. Zero means: no limit."""

    cpu: float = 0.0
    """Cores."""
    memory: int = 0
    """Bytes, of all its processes together, files in its memory file systems included."""
    processes: int = 0
    """Processes and threads."""
    weight: int = 0
    """Its share of a processor that others want too, relative to theirs; 100 for each slot."""


class SlotSettings(Protocol):
    """How much a slot is."""

    @property
    def slot_memory(self) -> int:
        """Bytes."""

    @property
    def slot_processes(self) -> int:
        """Processes and threads."""


WEIGHT_PER_SLOT = 100


def limits_of(resources: Resources, settings: SlotSettings) -> Limits:
    """The limits of a container: what it asks for itself, else as many slots' as its size says.

    Stores of earlier releases may hold requests for less memory than a container can live with.
    """
    size = max(1, resources.size)
    return Limits(
        cpu=max(0.0, resources.cpu),
        memory=max(resources.memory, MIN_MEMORY) if resources.memory > 0 else size * settings.slot_memory,
        processes=size * settings.slot_processes,
        weight=size * WEIGHT_PER_SLOT,
    )


def in_megabytes(size: int) -> str:
    """Write a number of bytes as users do, rounded up."""
    return f"{-(-size // MEGABYTE)} MB"


class ControlGroupUsage(NamedTuple):
    """What all processes of a control group consume, or consumed since it was made. None: not counted."""

    cpu_s: float | None = None
    throttled_s: float = 0.0
    """Seconds in which it was held back by its CPU limit."""
    memory: int | None = None
    """Bytes that cannot be had back without harm: files that are only cached do not count."""
    memory_peak: int = 0
    """Bytes, cached files included; 0 if it is not counted."""
    io_read: int = 0
    """Bytes from disks."""
    io_written: int = 0


class Troubles(NamedTuple):
    """How often a control group's limits struck since it was made."""

    oom_kills: int = 0
    """Processes that were killed because memory ran out."""
    refused_forks: int = 0
    """Processes and threads that could not be started."""


class ControlGroup(ABC):
    """The place of one container. Its methods do short, blocking file I/O."""

    limits: Limits
    """What is in force."""

    @property
    @abstractmethod
    def join(self) -> tuple[str, ...]:
        """Files into which a process writes its pid to join the group, before anything else of it runs."""

    @property
    @abstractmethod
    def rlimits(self) -> Mapping[int, int]:
        """What the container's own processes must limit by :func:`resource.setrlimit`, each for itself."""

    @abstractmethod
    def apply(self, limits: Limits) -> None:
        """Put other limits in force. May take long where memory has to be got back first.

        Raises:
            LimitError: They cannot be; the old ones stay. The text says what to do.
        """

    @abstractmethod
    def usage(self) -> ControlGroupUsage:
        """What its processes consume."""

    @abstractmethod
    def troubles(self) -> Troubles:
        """How often its limits struck; a few microseconds."""

    @abstractmethod
    def pids(self) -> list[int] | None:
        """Its processes; None if nobody knows."""

    @abstractmethod
    def kill(self) -> None:
        """Kill -9 all its processes, let it start no more, and wait until none is left. Blocks.

        Raises:
            KillError: Some process does not die.
        """

    @abstractmethod
    def remove(self) -> None:
        """Remove the control group, which has to be empty. Removing what is gone already does nothing.

        Raises:
            LimitError: Something is left in it.
        """


class Limiter(ABC):
    """A way to enforce limits."""

    name: ClassVar[str]
    detail: str = ""
    """What it cannot do on this machine, and what would help, in words; empty if nothing is missing."""

    @abstractmethod
    def probe(self) -> None:
        """Find out whether it works on this machine, and prepare it.

        Raises:
            LimitsUnavailableError: It does not; the text says why.
        """

    @property
    @abstractmethod
    def missing(self) -> frozenset[str]:
        """What of ``cpu``, ``memory``, ``processes`` and ``io`` it cannot limit or count here."""

    @abstractmethod
    def create(self, incarnation_id: str, limits: Limits) -> ControlGroup:
        """Make the control group of one incarnation of a container.

        Raises:
            LimitError: It cannot be made with these limits; nothing is left of it.
        """

    @abstractmethod
    def adopt(self, incarnation_id: str) -> ControlGroup:
        """The control group of a container that an earlier manager started; an empty shell if it has none."""

    @abstractmethod
    def sweep(self, keep: Collection[str]) -> None:
        """End and remove what earlier managers of this task set left, but for the groups of these marks."""

    @abstractmethod
    def close(self) -> None:
        """Remove what is not needed any more; cells that are there stay."""

    @abstractmethod
    def ceiling(self) -> Limits:
        """What the engine itself, and so all containers together, may use at most on this machine."""
