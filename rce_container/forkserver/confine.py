"""Turns a child of the fork server into an unprivileged process of a container.

Two processes do it. The first one enters the container's namespaces with the privileges it needs there; its
child, the first of the two inside the pid namespace, makes a user namespace below the one that owns all the
others. So no capability that a process of the container could gain applies to its mounts, its network or its
pids.
"""

from __future__ import annotations

import contextlib
import os
import resource
from pathlib import Path

from rce_container.environment import proc
from rce_container.environment.process import set_rlimits
from rce_container.forkserver import kernel, mounts
from rce_container.forkserver.kernel import Namespaces
from rce_container.forkserver.messages import Descriptors, SpawnRequest
from rce_container.forkserver.volumes import attached, mount_volumes

USER_ID = 1000
"""User and group inside."""

_JOINED = Namespaces.MOUNT | Namespaces.PID | Namespaces.IPC | Namespaces.UTS | Namespaces.CGROUP
_COUNTED = {"max_user_namespaces": 0, "max_inotify_instances": 32, "max_inotify_watches": 8192}
"""Limits of each user namespace. What the namespace uses counts for the user who made it too."""
_RLIMITS = {
    resource.RLIMIT_RTPRIO: 0,
    resource.RLIMIT_NICE: 0,
    resource.RLIMIT_SIGPENDING: 4096,
    resource.RLIMIT_MSGQUEUE: 1 << 18,
}
"""Limits that are stricter for containers than for the engine: priority, and resources that the kernel counts
for each user of the machine.

Numbers are those of ``setrlimit(2)``.
"""
_FILES = 16384
"""The soft limit of open files; a process may raise it."""
_NO_CORE = 1
"""The only size at which the kernel writes a core neither to a file nor to a program of the machine."""


def confine(request: SpawnRequest, descriptors: Descriptors, program: bytes) -> int:
    """Enter the container and drop all privileges. Return in a new process: the others have ended.

    Args:
        request: What the container is like.
        descriptors: Descriptors; they stay open.
        program: Filter of system calls; empty for none.

    Returns:
        A descriptor of the folder for logs.

    Raises:
        OSError: The kernel refuses; some privileges may remain.
    """
    for file in request.join:
        Path(file).write_text(str(os.getpid()))
    procfs = os.open("/proc", os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    with attached(request.volumes) as volumes:
        _enter(descriptors.holder, procfs, request)
        owner = request.uid or os.geteuid()
        mount_volumes(volumes, procfs, owner)
    mounts.limit(mounts.HOME, request.home_bytes, owner, 0o700)
    for path in mounts.TEMPORARY:
        mounts.limit(path, request.tmp_bytes, owner, 0o1777)
    mounts.mask_machine()
    logs = mounts.take_away_logs(owner)
    os.fchown(descriptors.log, owner, owner)
    _become_user(procfs, owner)
    os.close(procfs)
    _give_up(program)
    return logs


def _enter(holder: int, procfs: int, request: SpawnRequest) -> None:
    kinds = _JOINED if request.host_network else _JOINED | Namespaces.NET
    if request.uid:
        os.setgroups(())
    else:
        # The namespaces' owner, of whom the holder's own user namespace may be a child.
        pid = _pid_of(holder)
        mount_namespace = os.open(f"{pid}/ns/mnt", os.O_RDONLY | os.O_CLOEXEC, dir_fd=procfs)
        user_namespace = kernel.owner(mount_namespace)
        _check_alive(holder)
        kernel.join(user_namespace, Namespaces.USER)
        os.close(mount_namespace)
        os.close(user_namespace)
    kernel.join(holder, kinds)


def _pid_of(pidfd: int) -> int:
    for line in Path(f"/proc/self/fdinfo/{pidfd}").read_text().splitlines():
        if line.startswith("Pid:"):
            return int(line.split()[1])
    raise ProcessLookupError("the holder of the namespaces is gone")


def _check_alive(pidfd: int) -> None:
    """Verify that what was found by a pid belongs to the process and not to a later one."""
    if proc.has_ended(pidfd):
        raise ProcessLookupError("the holder of the namespaces is gone")


def _become_user(procfs: int, owner: int) -> None:
    """Continue as a child that is :data:`USER_ID` in its own user namespace, and ``owner`` outside."""
    made, make = os.pipe()
    mapped, map_ = os.pipe()
    child = os.fork()
    if child:
        os.close(make)
        os.close(mapped)
        if os.read(made, 1):
            for name in ("uid_map", "gid_map"):
                _write(procfs, f"{child}/{name}", f"{USER_ID} {owner} 1")
            os.write(map_, b"m")
        os._exit(0)
    os.close(made)
    os.close(map_)
    # The namespace's objects count for its creator. Root must not be the creator: it would pay for all
    # containers.
    kernel.keep_rights_as_another_user()
    os.setegid(owner)
    os.seteuid(owner)
    kernel.unshare(Namespaces.USER)
    os.write(make, b"u")
    if not os.read(mapped, 1):
        raise PermissionError("the user namespace was not mapped")
    os.close(make)
    os.close(mapped)
    for name, count in _COUNTED.items():
        with contextlib.suppress(FileNotFoundError):  # this kernel lacks the feature
            _write(procfs, f"sys/user/{name}", str(count))
    os.setresgid(USER_ID, USER_ID, USER_ID)
    os.setresuid(USER_ID, USER_ID, USER_ID)


def _give_up(program: bytes) -> None:
    os.setsid()
    os.umask(0o022)
    resource.setrlimit(resource.RLIMIT_CORE, (_NO_CORE, _NO_CORE))
    set_rlimits(_RLIMITS)
    _leave_files_to_others()
    kernel.give_up_capabilities()
    kernel.become_subreaper()
    kernel.set_dumpable(False)
    if program:
        kernel.filter_calls(program)


def _leave_files_to_others() -> None:
    """Allow half as many open files as the engine has.

    The kernel counts descriptors that wait in sockets per user of the machine. If that is the engine's user,
    containers must reach their limit before the engine does.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    half = hard // 2 if hard != resource.RLIM_INFINITY else hard
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(soft, half, _FILES), half))


def _write(folder: int, name: str, text: str) -> None:
    fd = os.open(name, os.O_WRONLY | os.O_CLOEXEC, dir_fd=folder)
    try:
        os.write(fd, text.encode())
    finally:
        os.close(fd)
