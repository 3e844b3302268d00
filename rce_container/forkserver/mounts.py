"""The last changes to a container's mounts, made inside it before any of its programs run.

This process may still mount; later ones may not, and cannot undo the changes.
"""

from __future__ import annotations

import os
from pathlib import Path

from rce_container.forkserver.kernel import Mount, mount, unmount

HOME = "/home/rce"
LOGS = "/var/log/rce"
TEMPORARY = ("/tmp", "/dev/shm")  # noqa: S108 - the container's own

_BYTES_PER_FILE = 4096
"""Bytes of a folder per file that it may hold: empty files take memory too."""
_FLAGS = Mount.NO_SUID | Mount.NO_DEV
_TERMINALS = 32
"""Per container; the machine has some thousands for all of them."""
_READ_ONLY_FROM_NOW_ON = Mount.REMOUNT | Mount.BIND | Mount.READ_ONLY | Mount.NO_SUID | Mount.NO_EXEC
_HIDDEN = (
    "/proc/acpi",
    "/proc/asound",
    "/proc/cmdline",
    "/proc/config.gz",
    "/proc/diskstats",
    "/proc/driver",
    "/proc/interrupts",
    "/proc/kallsyms",
    "/proc/kcore",
    "/proc/key-users",
    "/proc/keys",
    "/proc/kmsg",
    "/proc/latency_stats",
    "/proc/locks",
    "/proc/mdstat",
    "/proc/modules",
    "/proc/mtrr",
    "/proc/partitions",
    "/proc/sched_debug",
    "/proc/schedstat",
    "/proc/scsi",
    "/proc/slabinfo",
    "/proc/softirqs",
    "/proc/swaps",
    "/proc/timer_list",
    "/proc/timer_stats",
    "/proc/vmallocinfo",
)
_READ_ONLY = ("/proc/bus", "/proc/fs", "/proc/irq", "/proc/sys", "/proc/sysrq-trigger")


def limit(path: str, size: int, owner: int, mode: int) -> None:
    """Bound a folder that lives in memory, and give it to a user.

    Args:
        path: A tmpfs. What is in it already leads to mounts of what must stay where it is, as it is: the
            engine's modules, if they lie below that path.
        size: Bytes.
        owner: User and group.
        mode: Permissions.
    """
    options = f"size={size},nr_inodes={size // _BYTES_PER_FILE}"
    mount(path, Mount.REMOUNT | _FLAGS, options=options)
    os.chown(path, owner, owner)
    os.chmod(path, mode)  # noqa: PTH101 - like its neighbours
    for entry in os.scandir(path):
        _fasten(entry.path)


def take_away_logs(owner: int) -> int:
    """Remove every path to the container's logs; return a descriptor of their folder, and of nothing else."""
    logs = os.open(LOGS, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    os.fchown(logs, owner, owner)
    unmount(LOGS)
    return logs


def mask_machine() -> None:
    """Hide the machine's data in ``/proc`` and ``/sys``; make them and ``/dev`` read-only."""
    while os.path.ismount("/sys"):
        unmount("/sys")
    for path in filter(os.path.exists, _HIDDEN):
        if Path(path).is_dir():
            mount(path, _FLAGS | Mount.READ_ONLY | Mount.NO_EXEC, kind="tmpfs", options="size=0,mode=555")
        else:
            _bind_read_only("/dev/null", path)
    for path in filter(os.path.exists, _READ_ONLY):
        _bind_read_only(path, path)
    mount("/dev", _READ_ONLY_FROM_NOW_ON)
    terminals = f"max={_TERMINALS},ptmxmode=666,mode=620"
    mount("/dev/pts", Mount.REMOUNT | Mount.NO_SUID | Mount.NO_EXEC, options=terminals)


def _fasten(path: str) -> None:
    """Prevent renames of folders that lead to mounts, and new files beside the mounts."""
    if not os.path.ismount(path):
        mount(path, Mount.BIND | Mount.RECURSIVE, source=path)
        mount(path, _READ_ONLY_FROM_NOW_ON | Mount.NO_DEV)


def _bind_read_only(source: str, target: str) -> None:
    mount(target, Mount.BIND, source=source)
    flags = _READ_ONLY_FROM_NOW_ON
    mount(target, flags if source == "/dev/null" else flags | Mount.NO_DEV)
