"""Counts the remains of an engine on its machine: processes, mounts, cgroups, networks, sockets, folders.

It counts only objects of one engine, identified by its folder and by names that only its containers have,
because other engines may run on the same machine.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

from rce_container.environment import proc
from rce_container.limits import files

CGROUPS = Path("/sys/fs/cgroup")
INTERFACES = Path("/sys/class/net")
_PF_EXITING = 0x4
"""A flag of ``/proc/PID/stat`` (Linux's ``include/linux/sched.h``)."""
DEAD_AFTER_S = 600.0
"""Age from which an empty control group has no owner."""


class Footprint(NamedTuple):
    """The resources of a process."""

    fds: int
    networks: int
    """Descriptors of network namespaces."""
    memory: int
    """Resident bytes."""


class Traces:
    """All observed processes of one engine. Call :meth:`look` often, to observe short-lived ones too.

    Args:
        folder: In the command lines or environment variables of its programs; holds all of its files.
        words: Further words that only its processes have in their command lines, such as a container's tag.
    """

    def __init__(self, folder: Path, *words: str) -> None:
        self._folder = folder
        self._words = [word.encode() for word in words]
        self._seen: dict[int, int] = {}
        """Start times by pid."""
        self._marks: set[str] = set()
        self._tokens: set[str] = set()

    def look(self) -> list[proc.Process]:
        """Find all of its running processes, and remember them."""
        self._note_names()
        table = proc.table()
        roots = [pid for pid in table if self._is_ours(pid)]
        roots += [pid for cell in self.cgroups() for pid in files.pids(cell)]
        found = {one.pid: one for root in roots for one in proc.descendants(root, table)}
        found.pop(os.getpid(), None)
        self._seen.update((one.pid, one.start) for one in found.values())
        return list(found.values())

    def processes(self) -> list[proc.Process]:
        """Return all of its running processes, including those that are only known from observation."""
        self.look()
        known = (proc.read(pid) for pid in self._seen)
        return [one for one in known if one is not None and one.start == self._seen[one.pid]]

    def cgroups(self) -> list[Path]:
        """Return its cgroups, in every hierarchy."""
        return [path for path in task_set_cgroups() if path.name.removeprefix("rce-") in self._tokens]

    def left(self, but: Collection[int] = ()) -> list[str]:
        """Return the objects that should not exist after the end of its containers.

        Args:
            but: Processes that may stay, by pid: its programs, if they run.
        """
        self._note_names()
        found = [
            f"process {_describe(one.pid)}"
            for one in self.processes()
            if one.pid not in but and not _is_exiting(one.pid)
        ]
        found += [f"cgroup {path}" for path in self.cgroups()]
        found += [f"mount {line}" for line in self._mounts()]
        found += [f"interface {path.name}" for path in INTERFACES.iterdir() if path.name[1:] in self._marks]
        return found + [f"file {path}" for path in self._files()]

    def _note_names(self) -> None:
        for path in _walk(self._folder):
            if path.parent.name == "containers" or path.parent.name.startswith("c-"):
                self._marks.add(path.name)
            if path.name == "run" and path.is_file():
                with contextlib.suppress(OSError):
                    self._tokens.add(path.read_text())

    def _is_ours(self, pid: int) -> bool:
        if pid == os.getpid():
            return False
        in_both = [os.fsencode(self._folder), *(f"{proc.MARK}={mark}".encode() for mark in self._marks)]
        # Numbers of other programs' environments, such as systemd's JOURNAL_STREAM, may contain a word.
        for name, needles in (("cmdline", [*in_both, *self._words]), ("environ", in_both)):
            with contextlib.suppress(OSError):
                text = Path(f"/proc/{pid}/{name}").read_bytes()
                if any(needle in text for needle in needles):
                    return True
        return False

    def _mounts(self) -> list[str]:
        needles = [str(self._folder), *self._marks]
        lines = Path("/proc/self/mountinfo").read_text().splitlines()
        return [line for line in lines if any(needle in line for needle in needles)]

    def _files(self) -> Iterator[Path]:
        """Return the remains of containers in state folders, and sockets. Logs are kept."""
        for path in _walk(self._folder):
            of_container = path.name in self._marks and "logs" not in path.parts
            if of_container or (path.is_socket() and "link" in path.name) or path.suffix == ".new":
                yield path


def footprint(pid: int) -> Footprint:
    """Return a process's descriptors and memory."""
    kinds: Counter[str] = Counter()
    with contextlib.suppress(OSError):
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                kinds[str(entry.readlink()).partition(":")[0]] += 1
    process = proc.read(pid)
    return Footprint(kinds.total(), kinds["net"], process.resident if process is not None else 0)


def task_set_cgroups() -> Iterator[Path]:
    """Return the cgroups of all container task sets of the machine."""
    for parent, folders, _ in os.walk(CGROUPS):
        ours = [name for name in folders if name.startswith("rce-") and name != "rce-engine"]
        yield from (Path(parent, name) for name in ours)
        folders[:] = [name for name in folders if name not in ours]


def sweep_cgroups(folder: Path) -> list[Path]:
    """Kill the remaining processes in the cgroups of an engine that a test has ended, and remove them.

    Args:
        folder: Holds all of the engine's files.

    Returns:
        The cgroups that were left.
    """
    traces = Traces(folder)
    traces.look()
    found = traces.cgroups()
    for cgroup in found:
        for process in map(proc.read, files.pids(cgroup)):
            if process is not None:
                proc.kill(process)
        with contextlib.suppress(OSError):
            files.drop(cgroup)
    return found


def sweep_dead_cgroups() -> None:
    """Remove the remains of killed test runs: cgroups of task sets that have been empty for long.

    Younger ones may be those of a test run beside this one.
    """
    for cgroup in task_set_cgroups():
        for one in filter(_is_old, (*files.children(cgroup), cgroup)):
            with contextlib.suppress(OSError):
                one.rmdir()


def _is_old(cell: Path) -> bool:
    """Whether a control group has existed for longer than any container takes to start."""
    try:
        return time.time() - cell.stat().st_ctime > DEAD_AFTER_S
    except OSError:
        return False


def _walk(folder: Path) -> Iterator[Path]:
    """Return the contents of a folder, without files that disappear meanwhile."""
    for parent, folders, names in os.walk(folder):
        yield from (Path(parent, name) for name in (*folders, *names))


def _is_exiting(pid: int) -> bool:
    """Whether the kernel is removing a process, which may take a while on a busy machine."""
    with contextlib.suppress(OSError):
        text = Path(f"/proc/{pid}/stat").read_bytes()
        return bool(int(text[text.rindex(b")") + 2 :].split()[6]) & _PF_EXITING)
    return True


def _describe(pid: int) -> str:
    with contextlib.suppress(OSError):
        return f"{pid} {Path(f'/proc/{pid}/cmdline').read_bytes()[:200].replace(bytes(1), b' ').decode()}"
    return str(pid)
