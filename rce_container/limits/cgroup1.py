"""Cgroups of version 1: one hierarchy for each controller, or for a few of them together."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from rce_container.exceptions import LimitsUnavailableError
from rce_container.limits import files, hierarchy
from rce_container.limits.base import WEIGHT_PER_SLOT, ControlGroupUsage, Limits, Troubles
from rce_container.limits.cgroup import PERIOD_US, CgroupControlGroup, CgroupLimiter, quota

CONTROLLERS = {"memory": "memory", "pids": "processes", "cpu": "cpu", "cpuacct": "", "blkio": "io"}
"""The controllers that are used, the most important first, and the resources that need them."""

_UNLIMITED = 1 << 60
"""Memory limits beyond this mean: no limit."""
_SHARES = 1024
"""The default shares of a cgroup, and the weight of a single process."""
_MAX_SHARES = 1 << 18
_SHARES_PER_CORE = 4 * _SHARES
"""The weight of all containers together against single processes beside them, such as the engine's."""


class ControlGroupV1(CgroupControlGroup):
    """A folder in each hierarchy."""

    _memory_file = "memory.limit_in_bytes"

    def usage(self) -> ControlGroupUsage:
        """Read the counters."""
        memory = None
        if self._has("memory.usage_in_bytes"):
            idle = files.keyed(self._read("memory.stat")).get("total_inactive_file", 0)
            memory = max(0, self._number("memory.usage_in_bytes") - idle)
        io = parse_io(self._read("blkio.throttle.io_service_bytes_recursive"))
        return ControlGroupUsage(
            cpu_s=self._number("cpuacct.usage") / 1e9 if self._has("cpuacct.usage") else None,
            throttled_s=files.keyed(self._read("cpu.stat")).get("throttled_time", 0) / 1e9,
            memory=memory,
            memory_peak=self._number("memory.max_usage_in_bytes"),
            io_read=io.get("Read", 0),
            io_written=io.get("Write", 0),
        )

    def troubles(self) -> Troubles:
        """Read two files."""
        return Troubles(
            oom_kills=files.keyed(self._read("memory.oom_control")).get("oom_kill", 0),
            refused_forks=files.keyed(self._read("pids.events")).get("max", 0),
        )

    def _read_limits(self) -> Limits:
        memory = self._number("memory.limit_in_bytes")
        cpu = max(0, self._number("cpu.cfs_quota_us"))
        return Limits(
            cpu=cpu / (self._number("cpu.cfs_period_us") or PERIOD_US),
            memory=memory if memory < _UNLIMITED else 0,
            processes=self._number("pids.max"),
            weight=round(self._number("cpu.shares") / _SHARES * WEIGHT_PER_SLOT),
        )

    def _write_limits(self, limits: Limits) -> None:
        self._write_memory(limits.memory or -1)
        # Data that waits in TCP connections is not part of the memory in this version, and comes from one
        # store for the whole machine. Beyond this limit a connection gets only the minimum.
        self._write("memory.kmem.tcp.limit_in_bytes", limits.memory or -1)
        self._write("pids.max", limits.processes or "max")
        self._write("cpu.cfs_period_us", PERIOD_US)
        self._write("cpu.cfs_quota_us", quota(limits.cpu) or -1)
        self._write("cpu.shares", min(_MAX_SHARES, round((limits.weight or WEIGHT_PER_SLOT) / 100 * _SHARES)))

    def _write_memory(self, limit: int) -> None:
        """Limit memory, and memory with swap, which may never be the smaller of both."""
        names = ["memory.limit_in_bytes", "memory.memsw.limit_in_bytes"]
        if limit < 0 or limit > self._number(names[0]):
            names.reverse()
        for name in names:
            self._write(name, limit)

    def _needed(self) -> int:
        stat = files.keyed(self._read("memory.stat"))
        cached = stat.get("total_inactive_file", 0) + stat.get("total_active_file", 0)
        return max(0, self._number("memory.usage_in_bytes") - cached)


class Cgroup1(CgroupLimiter):
    """Needs one of the controllers memory, pids and cpu; usually that means root."""

    name = "cgroup1"
    control_group = ControlGroupV1

    def probe(self) -> None:
        """Try to make this task set's folder in each hierarchy."""
        found = [one for one in hierarchy.find(self._proc) if one.version == 1]
        places: dict[Path, hierarchy.Hierarchy] = {}
        working: set[str] = set()
        reasons = []
        for controller in CONTROLLERS:
            place = next((one for one in found if controller in one.controllers), None)
            if place is None:
                continue
            try:
                self._make_parent(place.folder / self._folder)
            except OSError as error:
                reasons.append(f"no cgroup can be made in {place.folder}: {error.strerror}")
                continue
            places[place.folder] = place
            working.add(controller)
        self._bases = tuple(places)
        self._mounts = tuple(place.mount for place in places.values())
        self._missing = frozenset(CONTROLLERS[name] for name in CONTROLLERS.keys() - working) - {""}
        self.close()
        if not working & {"memory", "pids", "cpu"}:
            raise LimitsUnavailableError(reasons[0] if reasons else "no hierarchy of version 1 is mounted")
        if self._missing:
            self.detail = f"of containers' {', '.join(sorted(self._missing))} no limit holds: " + (
                "; ".join(reasons) or "the controllers are not mounted"
            )

    def _make_parent(self, parent: Path) -> None:
        if parent.is_dir():
            return
        files.make(parent)
        with contextlib.suppress(OSError):  # exists only with the controller cpu
            files.write(parent / "cpu.shares", min(_MAX_SHARES, _SHARES_PER_CORE * (os.cpu_count() or 1)))


def parse_io(text: str) -> dict[str, int]:
    """Sum ``blkio.throttle.io_service_bytes`` over all disks, by operation."""
    sums: dict[str, int] = {}
    for line in text.splitlines():
        words = line.split()
        if len(words) == 3 and words[2].isdecimal():  # noqa: PLR2004 - the last line is a total
            sums[words[1]] = sums.get(words[1], 0) + int(words[2])
    return sums
