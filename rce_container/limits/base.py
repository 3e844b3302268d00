"""Limits, and the interface of the ways to enforce them.

A container has one *control group*, in which the machine counts and limits all of its processes together.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import ClassVar, NamedTuple, Protocol

from rce.model import MEGABYTE, MIN_MEMORY, Resources


class Limits(NamedTuple):
    """The limits of a container. Zero means: no limit."""

    cpu: float = 0.0
    """Cores."""
    memory: int = 0
    """Bytes, of all its processes together, files in its memory file systems included."""
    processes: int = 0
    """Processes and threads."""
    weight: int = 0
    """Its share of a contended processor, relative to the shares of others; 100 for each slot."""


class SlotSettings(Protocol):
    """The size of a slot."""

    @property
    def slot_memory(self) -> int:
        """Bytes."""

    @property
    def slot_processes(self) -> int:
        """Processes and threads."""


WEIGHT_PER_SLOT = 100


def limits_of(resources: Resources, settings: SlotSettings) -> Limits:
    """Return the limits of a container: as it requests, else those of its number of slots.

    Stores of earlier releases may hold requests for less memory than a container needs.
    """
    size = max(1, resources.size)
    return Limits(
        cpu=max(0.0, resources.cpu),
        memory=max(resources.memory, MIN_MEMORY) if resources.memory > 0 else size * settings.slot_memory,
        processes=size * settings.slot_processes,
        weight=size * WEIGHT_PER_SLOT,
    )


def in_megabytes(size: int) -> str:
    """Format a number of bytes as users write it, rounded up."""
    return f"{-(-size // MEGABYTE)} MB"


class ControlGroupUsage(NamedTuple):
    """The usage of all processes of a control group, now or since it was made. None: not counted."""

    cpu_s: float | None = None
    throttled_s: float = 0.0
    """Seconds in which it was held back by its CPU limit."""
    memory: int | None = None
    """Bytes that the kernel cannot reclaim without harm: files that are only cached do not count."""
    memory_peak: int = 0
    """Bytes, cached files included; 0 if it is not counted."""
    io_read: int = 0
    """Bytes from disks."""
    io_written: int = 0


class Troubles(NamedTuple):
    """How often a control group's limits were hit since it was made."""

    oom_kills: int = 0
    """Processes that were killed because memory ran out."""
    refused_forks: int = 0
    """Processes and threads that could not be started."""


class ControlGroup(ABC):
    """The control group of one container. Its methods do short, blocking file I/O."""

    limits: Limits
    """The limits in force."""

    @property
    @abstractmethod
    def join(self) -> tuple[str, ...]:
        """Files into which a process writes its pid to join the group, before anything else of it runs."""

    @property
    @abstractmethod
    def rlimits(self) -> Mapping[int, int]:
        """The limits that each process of the container must set for itself by :func:`resource.setrlimit`."""

    @abstractmethod
    def apply(self, limits: Limits) -> None:
        """Apply other limits. May take long if memory has to be reclaimed first.

        Raises:
            LimitError: They cannot be applied; the old ones stay. The text says what to do.
        """

    @abstractmethod
    def usage(self) -> ControlGroupUsage:
        """Return the usage of its processes."""

    @abstractmethod
    def troubles(self) -> Troubles:
        """Return how often its limits were hit; takes a few microseconds."""

    @abstractmethod
    def pids(self) -> list[int] | None:
        """Its processes; None if unknown."""

    @abstractmethod
    def kill(self) -> None:
        """Kill -9 all its processes, prevent new ones, and wait until none is left. Blocks.

        Raises:
            KillError: A process does not end.
        """

    @abstractmethod
    def remove(self) -> None:
        """Remove the control group, which has to be empty. Does nothing if it is already removed.

        Raises:
            LimitError: It is not empty.
        """


class Limiter(ABC):
    """A way to enforce limits."""

    name: ClassVar[str]
    detail: str = ""
    """What it cannot do on this machine and how to fix that, as text; empty if it can do everything."""

    @abstractmethod
    def probe(self) -> None:
        """Find out whether it works on this machine, and prepare it.

        Raises:
            LimitsUnavailableError: It does not; the text says why.
        """

    @property
    @abstractmethod
    def missing(self) -> frozenset[str]:
        """Those of ``cpu``, ``memory``, ``processes`` and ``io`` that it cannot limit or count here."""

    @abstractmethod
    def create(self, incarnation_id: str, limits: Limits) -> ControlGroup:
        """Make the control group of one incarnation of a container.

        Raises:
            LimitError: It cannot be made with these limits; a partly made group is removed.
        """

    @abstractmethod
    def adopt(self, incarnation_id: str) -> ControlGroup:
        """Return the control group of an adopted container; a stand-in if it has none."""

    @abstractmethod
    def sweep(self, keep: Collection[str]) -> None:
        """End and remove the groups that earlier managers left, except those of these marks."""

    @abstractmethod
    def close(self) -> None:
        """Remove what is not needed any more; existing control groups stay."""

    @abstractmethod
    def ceiling(self) -> Limits:
        """Return the limits of the engine itself, and so of all containers together, on this machine."""
