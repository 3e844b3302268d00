"""Limits for machines without cgroups: of each process by itself, and of a user's number of processes.

They keep one process from taking the machine's memory, not a container of many; processors are shared as
the kernel sees fit. Nothing is counted, and nothing changes while a container runs.
"""

from __future__ import annotations

import resource
from collections.abc import Collection, Mapping

from rce_container.exceptions import LimitError
from rce_container.limits.base import ControlGroup, ControlGroupUsage, Limiter, Limits, Troubles

_DETAIL = (
    "limits of containers are weak: no cgroup can be used, so memory is limited for each process only, "
    "and the CPU not at all"
)


def rlimits_of(limits: Limits) -> dict[int, int]:
    """What a process must limit for itself, so that memory and number of processes are bounded at all.

    The data segment is limited, not the address space: that counts what is only reserved, and programs with
    many threads or a garbage collector reserve much more than they ever use.
    """
    found = {resource.RLIMIT_DATA: limits.memory, resource.RLIMIT_NPROC: limits.processes}
    return {number: limit for number, limit in found.items() if limit}


class RlimitControlGroup(ControlGroup):
    """Exists on paper only.

    Args:
        limits: What its processes limit; None if that is not known (yet).
    """

    def __init__(self, limits: Limits | None) -> None:
        self._known = limits is not None
        self.limits = (limits or Limits())._replace(cpu=0.0)

    @property
    def join(self) -> tuple[str, ...]:
        """There is nothing to join."""
        return ()

    @property
    def rlimits(self) -> Mapping[int, int]:
        """All that there is."""
        return rlimits_of(self.limits)

    def apply(self, limits: Limits) -> None:
        """Refuse: nobody can change another process's limits for it and its children at once."""
        if not self._known:
            self._known, self.limits = True, limits._replace(cpu=0.0)
        if limits._replace(cpu=0.0) != self.limits:
            raise LimitError(
                "its limits cannot be changed while it runs: its machine has no cgroups that can be used; "
                "destroy it and create it again"
            )

    def usage(self) -> ControlGroupUsage:
        """Nobody counts."""
        return ControlGroupUsage()

    def troubles(self) -> Troubles:
        """Nobody counts."""
        return Troubles()

    def pids(self) -> None:
        """Nobody knows."""

    def kill(self) -> None:
        """The runtime finds its processes."""

    def remove(self) -> None:
        """Nothing is left of it."""


class RlimitLimiter(Limiter):
    """Works everywhere.

    Args:
        reason: Why nothing better works.
    """

    name = "rlimit"

    def __init__(self, reason: str = "") -> None:
        self.detail = f"{_DETAIL} ({reason})" if reason else _DETAIL

    def probe(self) -> None:
        """Nothing to find out."""

    @property
    def missing(self) -> frozenset[str]:
        """It counts nothing."""
        return frozenset({"cpu", "memory", "processes", "io"})

    def create(self, incarnation_id: str, limits: Limits) -> RlimitControlGroup:  # noqa: ARG002
        """Note the limits."""
        return RlimitControlGroup(limits)

    def adopt(self, incarnation_id: str) -> RlimitControlGroup:  # noqa: ARG002
        """Take the next limits that are asked for as those that it has."""
        return RlimitControlGroup(None)

    def sweep(self, keep: Collection[str]) -> None:
        """Nothing is ever left."""

    def close(self) -> None:
        """Nothing is ever left."""

    def ceiling(self) -> Limits:
        """Unknown."""
        return Limits()
