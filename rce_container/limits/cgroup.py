"""Base of the control groups and limiters of both versions of cgroups.

Below this program's own cgroup (in each hierarchy of version 1) there is one folder ``rce-TOKEN`` for each
container task set, and in it one for each incarnation of a container, named by its mark.
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import time
from abc import abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from rce_container.exceptions import KillError, LimitError
from rce_container.files import write_whole
from rce_container.limits import files, hierarchy
from rce_container.limits.base import ControlGroup, Limiter, Limits, in_megabytes
from rce_container.limits.rlimit import rlimits_of

PERIOD_US = 100_000
"""Length of the period of a CPU limit, in microseconds."""
MIN_QUOTA_US = 1000
"""The smallest quota that the kernel accepts for a period, in microseconds."""

_KILL_TIMEOUT_S = 10.0
_REMOVE_TIMEOUT_S = 2.0
_PAUSE_S = 0.01
_ATTEMPTS = 3


class CgroupControlGroup(ControlGroup):
    """One cgroup, or one in each of several hierarchies of version 1.

    A control file is searched for in all of them.

    Args:
        folders: The existing ones; empty for a container without cgroups.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = tuple(folders)
        self._files: dict[str, Path] = {}
        self.limits = self._read_limits() if folders else Limits()

    @property
    def join(self) -> tuple[str, ...]:
        """One file for each folder."""
        return tuple(str(folder / files.PROCS) for folder in self._folders)

    @property
    def rlimits(self) -> Mapping[int, int]:
        """Stand-ins for the controllers that are missing."""
        memory = 0 if self._has(self._memory_file) else self.limits.memory
        processes = 0 if self._has("pids.max") else self.limits.processes
        return rlimits_of(Limits(memory=memory, processes=processes))

    def apply(self, limits: Limits) -> None:
        """Write the control files."""
        if not self._folders:
            raise LimitError(
                "its limits cannot be changed while it runs: it was started without a cgroup; "
                "destroy it and create it again"
            )
        if limits == self.limits:
            return
        lowered = limits.memory and not 0 < self.limits.memory <= limits.memory
        if lowered and self._needed() > limits.memory:
            raise self._too_low(limits.memory)
        try:
            self._write_limits(limits)
        except OSError as error:
            with contextlib.suppress(OSError):
                self._write_limits(self.limits)
            if lowered and error.errno == errno.EBUSY:
                raise self._too_low(limits.memory) from error
            raise LimitError(f"the kernel refuses its limits: {error}") from error
        self.limits = limits

    def pids(self) -> list[int]:
        """Those in its first folder, which all join before the others."""
        return files.pids(self._folders[0]) if self._folders else []

    def kill(self) -> None:
        """The kernel kills them if it can; else they are killed one by one, while new ones are prevented."""
        deadline = time.monotonic() + _KILL_TIMEOUT_S
        while pids := {pid for folder in self._folders for pid in files.pids(folder)} - {os.getpid()}:
            if time.monotonic() > deadline:
                raise KillError(f"processes that cannot be killed: {sorted(pids)}")
            self._strike(pids)
            time.sleep(_PAUSE_S)

    def remove(self) -> None:
        """Retry for a while, because an ending process may still be in it.

        The folder of the task set goes with its last container.
        """
        deadline = time.monotonic() + _REMOVE_TIMEOUT_S
        for folder in self._folders:
            while True:
                try:
                    files.drop(folder)
                    break
                except OSError as error:
                    if time.monotonic() > deadline:
                        raise LimitError(
                            f"the cgroup {folder} cannot be removed: {error.strerror}"
                        ) from error
                time.sleep(_PAUSE_S)
            _drop_if_empty(folder.parent)

    def _strike(self, pids: Iterable[int]) -> None:
        if self._has("cgroup.kill"):
            with contextlib.suppress(OSError):  # it is removed when its last process has ended
                self._write("cgroup.kill", 1)
            return
        with contextlib.suppress(OSError):
            self._write("pids.max", 0)
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    # Control files, in any of the folders

    def _has(self, name: str) -> bool:
        if name not in self._files:
            found = next((folder / name for folder in self._folders if (folder / name).exists()), None)
            if found is None:
                return False
            self._files[name] = found
        return True

    def _read(self, name: str) -> str:
        return files.read(self._files[name]) if self._has(name) else ""

    def _number(self, name: str) -> int:
        return files.number(self._files[name]) if self._has(name) else 0

    def _write(self, name: str, value: int | str) -> None:
        """Write, unless the file's controller is missing."""
        if self._has(name):
            files.write(self._files[name], value)

    # Differences between the versions

    _memory_file: ClassVar[str]

    @abstractmethod
    def _read_limits(self) -> Limits: ...

    @abstractmethod
    def _write_limits(self, limits: Limits) -> None: ...

    @abstractmethod
    def _needed(self) -> int:
        """Bytes of memory that the kernel cannot reclaim."""

    def _too_low(self, wanted: int) -> LimitError:
        return LimitError(
            f"its memory cannot be limited to {in_megabytes(wanted)}: "
            f"it needs {in_megabytes(self._needed())} now; stop some of its nodes first, or ask for more"
        )


class CgroupLimiter(Limiter):
    """Makes control groups below this program's own cgroups.

    Args:
        token: A permanent name of the task set on this machine.
        ledger: A file of the task set; holds where its control groups were, since the next manager may be
            started in another cgroup.
        proc: See :func:`rce_container.limits.hierarchy.find`.
    """

    control_group: ClassVar[type[CgroupControlGroup]]

    def __init__(self, token: str, ledger: Path, proc: Path = hierarchy.PROC) -> None:
        self._folder = f"rce-{token}"
        self._ledger = ledger
        self._proc = proc
        self._bases: tuple[Path, ...] = ()
        """In each hierarchy, the cgroup below which everything is made."""
        self._mounts: tuple[Path, ...] = ()
        self._missing: frozenset[str] = frozenset()

    @property
    def missing(self) -> frozenset[str]:
        """The resources without a controller."""
        return self._missing

    def create(self, incarnation_id: str, limits: Limits) -> ControlGroup:
        """Make its folders and write its limits."""
        folders = [parent / incarnation_id for parent in self._parents]
        try:
            self._make(folders)
        except OSError as error:
            for folder in folders:
                with contextlib.suppress(OSError):
                    files.drop(folder)
            raise LimitError(f"its cgroup cannot be made: {error}") from error
        control_group = self.control_group(folders)
        try:
            control_group.apply(limits)
        except LimitError:
            control_group.remove()
            raise
        return control_group

    def adopt(self, incarnation_id: str) -> ControlGroup:
        """Find its folders, also where an earlier manager made them."""
        folders = [parent / incarnation_id for parent in self._all_parents()]
        return self.control_group([folder for folder in folders if folder.is_dir()])

    def sweep(self, keep: Collection[str]) -> None:
        """Find where this and earlier managers made control groups."""
        parents = self._all_parents()
        incarnation_ids = {child.name for parent in parents for child in files.children(parent)}
        for incarnation_id in sorted(incarnation_ids - set(keep)):
            control_group = self.adopt(incarnation_id)
            control_group.kill()
            control_group.remove()
        for parent in parents:
            if parent not in self._parents:
                _drop_if_empty(parent)
        kept = [parent for parent in parents if parent in self._parents or parent.is_dir()]
        write_whole(self._ledger, "".join(f"{parent}\n" for parent in kept).encode())

    def close(self) -> None:
        """Remove this task set's folders, if they are empty."""
        for parent in self._parents:
            _drop_if_empty(parent)

    def ceiling(self) -> Limits:
        """Return the smallest of the limits of this program's own cgroup and its ancestors."""
        found = [
            self.control_group([folder]).limits
            for base, mount in zip(self._bases, self._mounts, strict=True)
            for folder in _up(base, mount)
        ]
        return Limits(
            cpu=min((limits.cpu for limits in found if limits.cpu), default=0.0),
            memory=min((limits.memory for limits in found if limits.memory), default=0),
        )

    @property
    def _parents(self) -> tuple[Path, ...]:
        return tuple(base / self._folder for base in self._bases)

    def _all_parents(self) -> list[Path]:
        """Return the folders of this manager and of earlier ones of the task set."""
        former = map(Path, files.read(self._ledger).splitlines())
        return list(dict.fromkeys((*self._parents, *(one for one in former if one.name == self._folder))))

    def _make(self, folders: Iterable[Path]) -> None:
        """Make a container's folders; the end of another one may remove an empty parent meanwhile."""
        for attempt in range(_ATTEMPTS):
            try:
                for parent in self._parents:
                    self._make_parent(parent)
                for folder in folders:
                    files.make(folder)
            except FileNotFoundError:
                if attempt == _ATTEMPTS - 1:
                    raise
            else:
                return

    @abstractmethod
    def _make_parent(self, parent: Path) -> None:
        """Make ``rce-TOKEN`` as containers need it, if it does not exist.

        Raises:
            OSError: It cannot be made.
        """


def quota(cpu: float) -> int:
    """Microseconds in each period; 0 for no limit."""
    return max(MIN_QUOTA_US, round(cpu * PERIOD_US)) if cpu else 0


def _drop_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        files.remove(folder)


def _up(folder: Path, mount: Path) -> Iterator[Path]:
    yield folder
    yield from (parent for parent in folder.parents if parent.is_relative_to(mount))
