"""The usage of containers and their nodes: from their control groups' counters, else from ``/proc``."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from rce.control import EndpointUsage, NodeUsage
from rce_container.environment import proc
from rce_container.environment.messages import Counters
from rce_container.limits import ControlGroup
from rce_container.runtimes.base import Handle

_log = logging.getLogger(__name__)

_PSS_EVERY = 5
"""A process's share of memory is slow to read, so only every fifth measurement reads it."""


class Subject(NamedTuple):
    """A container to be measured."""

    handle: Handle
    control_group: ControlGroup
    nodes: Mapping[str, int]
    """The pid of each node's first process, as the machine sees it, by tag."""
    counters: Counters


class UsageMeter:
    """Measures containers.

    Lists the machine's processes only if a container's control group does not count.
    """

    def __init__(self) -> None:
        self._shares: dict[tuple[int, int], int] = {}
        self._fresh: dict[tuple[int, int], int] = {}
        self._table: dict[int, proc.Process] | None = None
        self._round = 0
        self._failed: set[str] = set()
        """Containers whose last measurement failed, which was logged."""

    def measure(self, containers: Mapping[str, Subject]) -> dict[str, EndpointUsage]:
        """Measure all containers. Blocks.

        Args:
            containers: By id.

        Returns:
            The usage by id, without containers that cannot be measured, which is logged once. A node's memory
            is its proportional share (PSS), or the resident size if that cannot be read; so is the
            container's, if its control group does not count.
        """
        self._round += 1
        self._table, self._fresh = None, {}
        usage: dict[str, EndpointUsage] = {}
        failed: set[str] = set()
        for id_, subject in containers.items():
            try:
                usage[id_] = self._measure(subject)
            except Exception:  # noqa: BLE001 - kernels print what was not expected; the others need their numbers
                failed.add(id_)
                if id_ not in self._failed:
                    _log.exception("the usage of the container %s cannot be measured", id_)
        self._table, self._shares = None, self._fresh
        self._failed = failed
        return usage

    def _measure(self, subject: Subject) -> EndpointUsage:
        control_group = subject.control_group
        own = self._processes(subject)
        counted = control_group.usage()
        cpu_s, memory = counted.cpu_s, counted.memory
        if cpu_s is None:
            cpu_s = sum(process.cpu_s for process in own)
        if memory is None:
            memory = sum(map(self._share, own))
        return EndpointUsage(
            interfaces=subject.counters.interfaces,
            nodes=self._measure_nodes(subject.nodes, own),
            cpu_s=round(cpu_s, 3),
            throttled_s=round(counted.throttled_s, 3),
            memory=memory,
            memory_peak=counted.memory_peak,
            memory_limit=0 if counted.memory is None else control_group.limits.memory,
            cpu_limit=control_group.limits.cpu,
            oom_kills=control_group.troubles().oom_kills,
            io_read=counted.io_read,
            io_written=counted.io_written,
            link_in=subject.counters.traffic[0],
            link_out=subject.counters.traffic[1],
            processes=len(own),
        )

    def _processes(self, subject: Subject) -> list[proc.Process]:
        if pids := subject.control_group.pids():
            return [process for pid in pids if (process := proc.read(pid)) is not None]
        if self._table is None:
            self._table = proc.table()
        return subject.handle.members(self._table)

    def _measure_nodes(self, nodes: Mapping[str, int], own: Iterable[proc.Process]) -> dict[str, NodeUsage]:
        own = list(own)
        owners = sort_out(nodes, own)
        found: dict[str, list[proc.Process]] = {tag: [] for tag in nodes}
        for process in own:
            if (tag := owners.get(process.pid)) is not None:
                found[tag].append(process)
        return {
            tag: NodeUsage(
                cpu_s=round(sum(process.cpu_s for process in processes), 3),
                memory=sum(map(self._share, processes)),
                processes=len(processes),
            )
            for tag, processes in found.items()
        }

    def _share(self, process: proc.Process) -> int:
        """Return a process's proportional share of memory, possibly of an earlier measurement."""
        key = process.pid, process.start
        if key not in self._fresh:
            share = self._shares.get(key)
            if share is None or not (process.pid + self._round) % _PSS_EVERY:
                share = proc.proportional(process.pid)
            self._fresh[key] = process.resident if share is None else share
        return self._fresh[key]


def sort_out(nodes: Mapping[str, int], processes: Iterable[proc.Process]) -> dict[int, str]:
    """Assign processes to nodes.

    A node has its own session. Its child processes belong to it even in another session, as long as their
    parent belongs to the node.

    Args:
        nodes: The pid of each node's first process, by tag.
        processes: All of the container.

    Returns:
        Tags by pid; without the processes that belong to no node.
    """
    leaders = {pid: tag for tag, pid in nodes.items() if pid}
    known = {process.pid: process for process in processes}
    owners = {pid: leaders[process.session] for pid, process in known.items() if process.session in leaders}
    for process in known.values():
        way: list[int] = []
        ancestor: proc.Process | None = process
        while ancestor is not None and ancestor.pid not in owners and ancestor.pid not in way:
            way.append(ancestor.pid)
            ancestor = known.get(ancestor.parent)
        if ancestor is not None and ancestor.pid in owners:
            owners.update(dict.fromkeys(way, owners[ancestor.pid]))
    return owners
