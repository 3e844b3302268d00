"""What the programs of a machine use: a control group for each machine, version 1 or 2, else ``/proc``.

Control groups also count programs that have ended, and can give a machine a share of the processor.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from rce_fleet.exceptions import ExperimentError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

ROOT = Path("/sys/fs/cgroup")
PERIOD_US = 100_000
"""Longest period in which a limited machine gets its share of the processor, unless that is very small."""
QUOTA_US = 2_000
"""The share of a period that is aimed at: a slow processor is slow, but it does not stop for long."""
LEAST_QUOTA_US = 1_000
"""The kernel takes no smaller one, and no period above a second: so 0.001 of a core is the least."""
REMOVE_TRIES = 50
_SECONDS = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class Usage:
    """What a machine's programs have used.

    Attributes:
        cpu_s: Processor time since the start, seconds.
        memory: Bytes that they take now.
    """

    cpu_s: float
    memory: int


class Meter(Protocol):
    """Counts what the programs of one machine use."""

    limits: bool
    """Whether it can limit the share of the processor."""

    @property
    def prefix(self) -> tuple[str, ...]:
        """Words before a command that have its processes counted."""

    def limit(self, cores: float) -> None:
        """Give the machine so much of a core at most; 0: no limit.

        Raises:
            ExperimentError: It cannot be limited here.
        """

    def read(self) -> Usage:
        """Return what was used."""

    def processes(self) -> set[int]:
        """Return the ids of the processes that are counted now."""

    def close(self) -> None:
        """Stop counting; the programs must have ended."""


def period_us(cores: float) -> int:
    """Return the period in which a machine gets so much of a core, microseconds."""
    if not cores:
        return PERIOD_US
    return max(min(PERIOD_US, int(QUOTA_US / cores)), ceil(LEAST_QUOTA_US / cores))


def quota_us(cores: float) -> int:
    """Return how long a machine may run in each of its periods, microseconds."""
    return max(round(cores * period_us(cores)), LEAST_QUOTA_US)


def make_meter(name: str, namespace: str) -> Meter:
    """Return a meter for a machine.

    Args:
        name: Of the control group; no other may have it.
        namespace: The machine's network namespace, by which its processes are found without control groups.
    """
    makers: tuple[Callable[[str], Meter], ...] = (ControlGroups1, ControlGroup2)
    for make in makers:
        with contextlib.suppress(OSError):
            return make(name)
    return ProcessTable(namespace)


class ControlGroups1:
    """Control groups of version 1: ``cpu``, ``cpuacct`` and ``memory``.

    Raises:
        OSError: They cannot be made.
    """

    limits = True

    def __init__(self, name: str) -> None:
        self._groups = {kind: ROOT / kind / name for kind in ("cpu", "cpuacct", "memory")}
        for kind in self._groups:
            if not (ROOT / kind / "cgroup.procs").exists():
                raise FileNotFoundError(ROOT / kind)
        for group in self._groups.values():
            group.mkdir(exist_ok=True)

    @property
    def prefix(self) -> tuple[str, ...]:
        """Words before a command."""
        return _joining(self._groups.values())

    def limit(self, cores: float) -> None:
        """Give the machine so much of a core at most; 0: no limit."""
        period = period_us(cores)
        quota = self._groups["cpu"] / "cpu.cfs_quota_us"
        # The kernel refuses a pair that it does not take as a whole: no limit fits every period.
        quota.write_text("-1")
        (self._groups["cpu"] / "cpu.cfs_period_us").write_text(str(period))
        if cores:
            quota.write_text(str(quota_us(cores)))

    def read(self) -> Usage:
        """Return what was used; cached files do not count."""
        nanoseconds = int((self._groups["cpuacct"] / "cpuacct.usage").read_text())
        fields = _fields(self._groups["memory"] / "memory.stat")
        return Usage(nanoseconds / 1e9, fields.get("total_rss", 0))

    def processes(self) -> set[int]:
        """Return the ids of the processes that are counted now."""
        return {pid for group in self._groups.values() for pid in processes_in_group(group)}

    def close(self) -> None:
        """Remove the groups."""
        for group in self._groups.values():
            remove_group(group)


class ControlGroup2:
    """A control group of version 2.

    Raises:
        OSError: It cannot be made.
    """

    limits = True

    def __init__(self, name: str) -> None:
        controllers = (ROOT / "cgroup.controllers").read_text().split()
        if not {"cpu", "memory"} <= set(controllers):
            raise FileNotFoundError(ROOT / "cgroup.controllers")
        (ROOT / "cgroup.subtree_control").write_text("+cpu +memory")
        self._group = ROOT / name
        self._group.mkdir(exist_ok=True)

    @property
    def prefix(self) -> tuple[str, ...]:
        """Words before a command."""
        return _joining([self._group])

    def limit(self, cores: float) -> None:
        """Give the machine so much of a core at most; 0: no limit."""
        period = period_us(cores)
        quota = str(quota_us(cores)) if cores else "max"
        (self._group / "cpu.max").write_text(f"{quota} {period}")

    def read(self) -> Usage:
        """Return what was used; cached files do not count."""
        microseconds = _fields(self._group / "cpu.stat").get("usage_usec", 0)
        return Usage(microseconds / 1e6, _fields(self._group / "memory.stat").get("anon", 0))

    def processes(self) -> set[int]:
        """Return the ids of the processes that are counted now."""
        return set(processes_in_group(self._group))

    def close(self) -> None:
        """Remove the group."""
        remove_group(self._group)


class ProcessTable:
    """Counts the processes in a network namespace by ``/proc``.

    Programs that end between two readings count only as far as their parents waited for them.
    """

    limits = False
    prefix: tuple[str, ...] = ()

    def __init__(self, namespace: str) -> None:
        self._namespace = namespace
        self._most: dict[tuple[int, int], float] = {}
        """Processor time by process id and start."""

    def limit(self, cores: float) -> None:
        """Refuse a limit."""
        if cores:
            raise ExperimentError("without control groups a machine's processor time cannot be limited")

    def read(self) -> Usage:
        """Return what was used."""
        memory = 0
        for pid in self.processes():
            with contextlib.suppress(OSError, IndexError):
                fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
                self._most[pid, int(fields[19])] = sum(map(int, fields[11:13])) / _SECONDS
                memory += int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE
        return Usage(sum(self._most.values()), memory)

    def processes(self) -> set[int]:
        """Return the ids of the processes that are counted now."""
        return processes_in(self._namespace)

    def close(self) -> None:
        """Nothing is left to remove."""


def _joining(groups: Iterable[Path]) -> tuple[str, ...]:
    files = " ".join(f"{group}/cgroup.procs" for group in groups)
    return ("sh", "-c", f'for file in {files}; do echo $$ > "$file" || exit 125; done; exec "$@"', "sh")


def _fields(path: Path) -> dict[str, int]:
    pairs = (line.split() for line in path.read_text().splitlines())
    return {pair[0]: int(pair[1]) for pair in pairs if len(pair) == 2}  # noqa: PLR2004 - name and value


def processes_in(namespace: str) -> set[int]:
    """Return the ids of the processes in a network namespace."""
    shown = subprocess.run(  # noqa: S603 - a fixed program
        ["ip", "netns", "pids", namespace],  # noqa: S607 - wherever the system has it
        check=False,
        capture_output=True,
        text=True,
    ).stdout
    return {int(pid) for pid in shown.split()}


def processes_in_group(group: Path) -> Iterator[int]:
    """Yield the ids of the processes in a control group and those below it."""
    for file in group.rglob("cgroup.procs"):
        with contextlib.suppress(FileNotFoundError):
            yield from map(int, file.read_text().split())


def remove_group(group: Path) -> None:
    """Remove a control group and those below it; their processes must have been told to end.

    Raises:
        OSError: A process of it does not end.
    """
    with contextlib.suppress(FileNotFoundError):
        for below in [path for path in group.iterdir() if path.is_dir()]:
            remove_group(below)
    for attempt in range(REMOVE_TRIES):
        try:
            group.rmdir()
        except FileNotFoundError:
            return
        except OSError:  # busy: its last process is about to end
            if attempt == REMOVE_TRIES - 1:
                raise
            time.sleep(0.1)
        else:
            return
