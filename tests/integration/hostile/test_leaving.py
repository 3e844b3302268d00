"""Nodes that try to leave their container. Each attempt must be refused in the way that is named here."""

from __future__ import annotations

from typing import Any

import pytest
from support.hostile_world import MODULE
from support.persons import Person

pytestmark = [pytest.mark.needs("bwrap")]

EPERM, EACCES, ENOSYS, EROFS = "EPERM", "EACCES", "ENOSYS", "EROFS"
NO_RIGHT, INVISIBLE, ABSENT, CLOSED = {EPERM}, {ENOSYS}, {"ENOENT"}, {EACCES, EPERM}
NAMESPACES = ("mount", "cgroup", "uts", "ipc", "user", "pid", "net", "time")

PROCESSES: dict[str, set[str]] = {
    f"{what} of {who}": CLOSED
    for who in ("environment", "node fork server", "holder")
    for what in (
        *("mem", "environ", "maps", "auxv", "io", "stack", "syscall", "root", "cwd", "exe", "fd/0", "ns/mnt"),
        *("descriptor", "ptrace", "process_vm_readv", "process_vm_writev", "process_madvise"),
        *("pidfd_getfd", "kcmp"),
    )
} | {f"file mapped by {who}": CLOSED for who in ("environment", "node fork server", "holder")}

CALLS = {
    **{f"{call} {kind}": INVISIBLE for call in ("unshare", "clone") for kind in NAMESPACES},
    **{f"setns {name}": NO_RIGHT for name in ("mnt", "cgroup", "uts", "ipc", "user", "pid", "net", "time")},
    **dict.fromkeys(("clone3", "io_setup", "memfd_secret"), INVISIBLE),
    **dict.fromkeys(
        (
            *("chroot", "name_to_handle_at", "acct", "add_key", "bpf", "delete_module", "fanotify_init"),
            *("fsopen", "io_uring_setup", "keyctl", "lookup_dcookie", "open_tree", "perf_event_open"),
            *("quotactl", "request_key", "setdomainname", "swapoff", "syslog", "userfaultfd", "vhangup"),
        ),
        NO_RIGHT,
    ),
    "sync": {"done"},  # and nothing happens: see the tests of the filter
    "32-bit call": {"SIGSYS"},
    "x32 call": {"SIGSYS"},
    **{f"{family} socket": INVISIBLE for family in ("packet", "alg", "vsock")},
    "raw socket": NO_RIGHT,
    **{f"netlink {family}": INVISIBLE for family in ("unused", "audit", "uevent", "generic")},
}

LIMITS = {
    "real time": NO_RIGHT,
    "nice": {EACCES},
    "terminals": {"limited to 32"},
    "inotify": {"limited to 32"},
    "huge pages": INVISIBLE,
    "huge memfd": INVISIBLE,
    "lease": INVISIBLE,
    "waiting signals": {"limited"},
    "message queues": {"limited"},
}

ADDRESSES = {
    "abstract socket of the machine": {"ECONNREFUSED"},
    "loopback of the machine": {"ECONNREFUSED"},
    **{
        f"{name} socket of the machine": ABSENT
        for name in ("bound", "control", "link", "docker", "podman", "bus", "systemd", "journal")
    },
}

FILES = {
    **{
        f"write sys/{name}": {EROFS}
        for name in (
            *("kernel/core_pattern", "kernel/hostname", "kernel/ns_last_pid", "kernel/randomize_va_space"),
            *("user/max_user_namespaces", "vm/overcommit_memory"),
        )
    },
    "write sys/kernel/modprobe": {EROFS, "ENOENT"},  # not every kernel has modules or keys for emergencies
    "write sysrq-trigger": {EROFS, "ENOENT"},
    **{
        f"write {path}": {EROFS}
        for path in ("/etc/passwd", "/usr/x", "/x", "/run/x", "/dev/x", "/opt/rce/bundles/x", "package")
    },
    **{
        f"mount {kind}": NO_RIGHT
        for kind in ("cgroup", "cgroup2", "proc", "sysfs", "tmpfs", "devtmpfs", "overlay", "fuse", "bind")
    },
    **dict.fromkeys(("remount /usr", "remount home", "unmount /proc/sys", "pivot_root"), NO_RIGHT),
    "device": NO_RIGHT,
    "memory device": NO_RIGHT,
    "hard link to the machine's": {"EXDEV"},
    "programs run with their owner's rights": {"none"},
    "modules of the environment": {"none"},
    "cgroup files": ABSENT,
    "controlling terminal": {"ENXIO"},
    "type ahead": {"ENOTTY"},
}

PROGRAMS = {
    f"run {words}": {"fails", "is not there"}
    for words in (
        "su -c true",
        "mount -t tmpfs none /tmp",
        "umount /dev/shm",
        "bwrap --bind / / true",
        "bwrap --unshare-user --bind / / true",
        "unshare --user true",
        "nsenter --target 1 --mount true",
        "newuidmap {self} 0 0 1",
        "fusermount3 -u /tmp",
        "setpriv --reuid=0 true",
        "chroot / true",
        "ip link set lo down",
    )
}

RIGHTS = {
    "setuid": {"EINVAL"},
    "setgid": {"EINVAL"},
    **dict.fromkeys(("setgroups", "user map", "capset", "ambient", "secure bits"), NO_RIGHT),
    "no_new_privs": {"stays 1"},
    "seccomp": {"EINVAL"},
    **{name: {"ValueError: not allowed to raise maximum limit"} for name in ("hard limit", "core")},
    "credentials": {EPERM, "EINVAL"},
    **{
        f"{what} {who}": {"ESRCH"}
        for what in ("signal", "rlimit of")
        for who in ("manager", "shim", "neighbour")
    },
}

GAMES = {
    **{
        name: {"done"}
        for name in ("file with a strange name", "link to the machine", "fifo", "closed folder")
    },
    "logs": {EACCES, "nothing"},
    "oom score": {"done", EACCES},  # not lower than its environment's where the engine has all rights
}

EXPECTED = {**PROCESSES, **CALLS, **LIMITS, **ADDRESSES, **FILES, **PROGRAMS, **RIGHTS, **GAMES}

SAME_OUTSIDE = {
    *(f"{name} socket of the machine" for name in ("docker", "podman", "bus", "systemd", "journal")),
    "sync",
    "message queues",
    "real time",  # the cgroup that the tests run in may have no share of it
}
"""What ends in the same way, or may, without a container: there is none of it, or everybody may do it."""


WALLS = {
    **PROCESSES,
    **ADDRESSES,
    **FILES,
    **PROGRAMS,
    **RIGHTS,
    **{f"{call} {kind}": NO_RIGHT for call in ("unshare", "clone") for kind in NAMESPACES},
    **{f"{call} user": {"ENOSPC"} for call in ("unshare", "clone")},
    **{name: CALLS[name] for name in CALLS if name.startswith("setns")},
    **{name: LIMITS[name] for name in ("real time", "nice", "terminals", "inotify", "waiting signals")},
    "clone time": {"done", EPERM},  # of no use: it may set no clock there
    "setns user": {"EINVAL"},
    **dict.fromkeys(("chroot", "bpf", "fsopen", "open_tree", "syslog", "swapoff", "vhangup"), NO_RIGHT),
    **dict.fromkeys(("packet socket", "raw socket"), NO_RIGHT),
}
"""What must hold on a machine on which no filter of system calls can be made."""


@pytest.fixture(scope="module")
def unfiltered(root_person: Person) -> dict[str, Any]:
    found: dict[str, Any] = root_person.run("unfiltered", module=MODULE)["executed"]["results"]
    return found


def test_the_walls_stand_without_a_filter(unfiltered: dict[str, Any]) -> None:
    assert {
        name: result for name, result in unfiltered.items() if result not in WALLS.get(name, {result})
    } == {}
    assert unfiltered["userfaultfd"] == "done", "there is no filter"


@pytest.mark.parametrize("attempt", EXPECTED)
def test_it_is_refused(attacked: dict[str, Any], attempt: str) -> None:
    for how in ("leave", "executed"):
        assert attacked[how]["results"][attempt] in EXPECTED[attempt], how


def test_nothing_else_was_tried_and_the_targets_were_there(attacked: dict[str, Any]) -> None:
    for how in ("leave", "executed"):
        assert set(attacked[how]["results"]) == set(EXPECTED)
        assert all(attacked[how]["targets"].values())


def test_without_a_container_root_gets_through(attacked: dict[str, Any], person: Person) -> None:
    outside = attacked["outside"]
    assert len(outside) > 90
    if person.uid == 0:
        same = {name for name, result in outside.items() if result in EXPECTED[name]}
        assert same <= SAME_OUTSIDE


def test_the_container_pays_for_what_the_kernel_counts(attacked: dict[str, Any], person: Person) -> None:
    """Not root, in whose name it would be taken from all containers and from the machine."""
    if person.uid == 0:
        owner, user = attacked["owner"]
        assert owner == user != 0


def test_the_neighbour_was_left_alone(attacked: dict[str, Any]) -> None:
    assert attacked["neighbour lives"]
