"""Cgroups of version 2: one hierarchy, in which a subtree may be delegated to a user or a service.

A cgroup that gives controllers to cgroups below it may not hold processes itself (except the root). So the
processes of this program's own cgroup, the program included, move into one below it, ``rce-engine``.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterable
from pathlib import Path

from rce_container.exceptions import LimitsUnavailableError
from rce_container.limits import files, hierarchy
from rce_container.limits.base import WEIGHT_PER_SLOT, ControlGroupUsage, Limits, Troubles
from rce_container.limits.cgroup import PERIOD_US, CgroupControlGroup, CgroupLimiter, quota

ENGINE = "rce-engine"
CONTROLLERS = {"memory": "memory", "pids": "processes", "cpu": "cpu", "io": "io"}
"""The controllers that are used, the most important first, and the resources that need them."""

_SUBTREE = "cgroup.subtree_control"
_IO_BYTES = ("rbytes", "wbytes")
_MAX_WEIGHT = 10_000
_WEIGHT_PER_CORE = 400
_HINT = "give it one: a systemd unit with Delegate=yes, or `systemd-run --scope -p Delegate=yes ...`"


class ControlGroupV2(CgroupControlGroup):
    """One folder."""

    _memory_file = "memory.max"

    def usage(self) -> ControlGroupUsage:
        """Read the counters."""
        cpu = files.keyed(self._read("cpu.stat"))
        memory = None
        if self._has("memory.current"):
            idle = files.keyed(self._read("memory.stat")).get("inactive_file", 0)
            memory = max(0, self._number("memory.current") - idle)
        io = parse_io(self._read("io.stat"))
        return ControlGroupUsage(
            cpu_s=cpu["usage_usec"] / 1e6 if "usage_usec" in cpu else None,
            throttled_s=cpu.get("throttled_usec", 0) / 1e6,
            memory=memory,
            memory_peak=self._number("memory.peak"),
            io_read=io.get("rbytes", 0),
            io_written=io.get("wbytes", 0),
        )

    def troubles(self) -> Troubles:
        """Read two files."""
        return Troubles(
            oom_kills=files.keyed(self._read("memory.events")).get("oom_kill", 0),
            refused_forks=files.keyed(self._read("pids.events")).get("max", 0),
        )

    def _read_limits(self) -> Limits:
        words = self._read("cpu.max").split()
        limited = len(words) == 2 and words[0] != "max"  # noqa: PLR2004 - quota and period
        return Limits(
            cpu=int(words[0]) / int(words[1]) if limited else 0.0,
            memory=self._number("memory.max"),
            processes=self._number("pids.max"),
            weight=self._number("cpu.weight"),
        )

    def _write_limits(self, limits: Limits) -> None:
        # memory.oom.group stays off: the kernel kills the one process that is too large, not the container.
        self._write("memory.max", limits.memory or "max")
        self._write("memory.swap.max", 0 if limits.memory else "max")
        self._write("pids.max", limits.processes or "max")
        self._write("cpu.max", f"{quota(limits.cpu) or 'max'} {PERIOD_US}")
        self._write("cpu.weight", min(_MAX_WEIGHT, limits.weight or WEIGHT_PER_SLOT))

    def _needed(self) -> int:
        stat = files.keyed(self._read("memory.stat"))
        cached = stat.get("inactive_file", 0) + stat.get("active_file", 0)
        return max(0, self._number("memory.current") - cached)


class Cgroup2(CgroupLimiter):
    """Needs a subtree that belongs to this user: as root, or delegated."""

    name = "cgroup2"
    control_group = ControlGroupV2

    def probe(self) -> None:
        """Give controllers to the cgroups below, and try to make this task set's folder."""
        place = next((one for one in hierarchy.find(self._proc) if one.version == 2), None)  # noqa: PLR2004
        if place is None:
            raise LimitsUnavailableError("no hierarchy of version 2 is mounted")
        base = place.folder.parent if place.folder.name == ENGINE else place.folder
        offered = files.read(base / "cgroup.controllers").split()
        wanted = [name for name in CONTROLLERS if name in offered]
        if not {"memory", "pids", "cpu"} & set(wanted):
            if not CONTROLLERS.keys() & set(files.read(place.mount / "cgroup.controllers").split()):
                raise LimitsUnavailableError("all controllers belong to version 1")
            raise LimitsUnavailableError(f"the cgroup {base} has no controllers; {_HINT}")
        try:
            _enable(base, wanted)
            self._make_parent(base / self._folder)
        except OSError as error:
            raise LimitsUnavailableError(
                f"the cgroup {base} may not be used: {error.strerror}; {_HINT}"
            ) from error
        self._bases, self._mounts = (base,), (place.mount,)
        self.close()
        if not os.access(base / files.PROCS, os.W_OK):
            raise LimitsUnavailableError(f"no process may be moved within the cgroup {base}; {_HINT}")
        self._missing = frozenset(CONTROLLERS[name] for name in CONTROLLERS.keys() - set(wanted))
        if self._missing:
            self.detail = (
                f"of containers' {', '.join(sorted(self._missing))} no limit holds: "
                f"the cgroup {base} has no such controllers"
            )

    def _make_parent(self, parent: Path) -> None:
        if parent.is_dir():
            return
        files.make(parent)
        offered = files.read(parent / "cgroup.controllers").split()
        files.write(parent / _SUBTREE, _request(name for name in CONTROLLERS if name in offered))
        if not (parent.parent / "cgroup.type").exists():  # the root, whose processes compete one by one
            with contextlib.suppress(OSError):
                weight = min(_MAX_WEIGHT, _WEIGHT_PER_CORE * (os.cpu_count() or 1))
                files.write(parent / "cpu.weight", weight)


def _enable(base: Path, controllers: list[str]) -> None:
    """Give controllers to the cgroups below ``base``; move its own processes away if necessary.

    Raises:
        OSError: Not permitted.
    """
    if set(controllers) <= set(files.read(base / _SUBTREE).split()):
        return
    try:
        files.write(base / _SUBTREE, _request(controllers))
    except OSError as error:
        if error.errno != errno.EBUSY:
            raise
        _move_processes(base, base / ENGINE)
        files.write(base / _SUBTREE, _request(controllers))


def _move_processes(source: Path, target: Path) -> None:
    files.make(target)
    for pid in files.read(source / files.PROCS).split():
        with contextlib.suppress(ProcessLookupError):
            files.write(target / files.PROCS, pid)


def _request(controllers: Iterable[str]) -> str:
    return " ".join(f"+{name}" for name in controllers)


def parse_io(text: str) -> dict[str, int]:
    """Sum the bytes read and written of ``io.stat`` over all disks.

    Some kernels print several disks in one line, and statistics for debugging have words as values.
    """
    sums: dict[str, int] = {}
    for word in text.split():
        key, _, value = word.partition("=")
        if key in _IO_BYTES and value.isdecimal():
            sums[key] = sums.get(key, 0) + int(value)
    return sums
