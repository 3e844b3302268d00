"""Limits for machines without cgroups: for each process, and for a user's number of processes.

They prevent one process from taking the machine's memory, but not a container with many processes; the kernel
shares the processors. Usage is not counted, and limits do not change while a container runs.
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
    """Return the limits that a process must set for itself, to bound memory and the number of processes.

    The data segment is limited, not the address space: the address space includes memory that is only
    reserved, and programs with many threads or a garbage collector reserve much more than they ever use.
    """
    found = {resource.RLIMIT_DATA: limits.memory, resource.RLIMIT_NPROC: limits.processes}
    return {number: limit for number, limit in found.items() if limit}


class RlimitControlGroup(ControlGroup):
    """A control group without a cgroup: only holds the limits.

    Args:
        limits: The limits that its processes set; None if not known (yet).
    """

    def __init__(self, limits: Limits | None) -> None:
        self._known = limits is not None
        self.limits = (limits or Limits())._replace(cpu=0.0)

    @property
    def join(self) -> tuple[str, ...]:
        """Return an empty tuple: processes have no group to join."""
        return ()

    @property
    def rlimits(self) -> Mapping[int, int]:
        """Return the limits that each process sets for itself."""
        return rlimits_of(self.limits)

    def apply(self, limits: Limits) -> None:
        """Refuse: the limits of a process and its children cannot be changed at once from outside."""
        if not self._known:
            self._known, self.limits = True, limits._replace(cpu=0.0)
        if limits._replace(cpu=0.0) != self.limits:
            raise LimitError(
                "its limits cannot be changed while it runs: its machine has no cgroups that can be used; "
                "destroy it and create it again"
            )

    def usage(self) -> ControlGroupUsage:
        """Return an empty usage: it is not counted."""
        return ControlGroupUsage()

    def troubles(self) -> Troubles:
        """Return no troubles: they are not counted."""
        return Troubles()

    def pids(self) -> None:
        """Return None: the processes are unknown."""

    def kill(self) -> None:
        """Do nothing: the runtime finds its processes."""

    def remove(self) -> None:
        """Do nothing."""


class RlimitLimiter(Limiter):
    """Sets limits by :func:`resource.setrlimit`; works on every machine.

    Args:
        reason: Why the other limiters do not work.
    """

    name = "rlimit"

    def __init__(self, reason: str = "") -> None:
        self.detail = f"{_DETAIL} ({reason})" if reason else _DETAIL

    def probe(self) -> None:
        """Do nothing."""

    @property
    def missing(self) -> frozenset[str]:
        """Return all resources: none is counted."""
        return frozenset({"cpu", "memory", "processes", "io"})

    def create(self, incarnation_id: str, limits: Limits) -> RlimitControlGroup:  # noqa: ARG002
        """Make a control group with these limits."""
        return RlimitControlGroup(limits)

    def adopt(self, incarnation_id: str) -> RlimitControlGroup:  # noqa: ARG002
        """Return a control group whose limits are the first requested ones."""
        return RlimitControlGroup(None)

    def sweep(self, keep: Collection[str]) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def ceiling(self) -> Limits:
        """Return no limits: the ceiling is unknown."""
        return Limits()
