"""Tries to leave the container: prints, as JSON, how each attempt ended.

``leave.py FILE [outside]``: a file of facts, in JSON, says what is worth a try; outside of a container, with
processes of its own to attack, it tries only what hurts nobody.
"""

from __future__ import annotations

import ctypes
import fcntl
import json
import mmap
import os
import resource
import signal
import socket
import stat
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from attempts import Attack, attempt_all, find_process, libc, system

NAMESPACES = {
    "mount": 0x2_0000,
    "cgroup": 0x200_0000,
    "uts": 0x400_0000,
    "ipc": 0x800_0000,
    "user": 0x1000_0000,
    "pid": 0x2000_0000,
    "net": 0x4000_0000,
    "time": 0x80,
}
NS_FILES = ("mnt", "cgroup", "uts", "ipc", "user", "pid", "net", "time")
INSIDES = ("mem", "environ", "maps", "auxv", "io", "stack", "syscall")
LINKS = ("root", "cwd", "exe", "fd/0", "ns/mnt")
PROTECTED_SETTINGS = (
    "sys/kernel/core_pattern",
    "sys/kernel/modprobe",
    "sys/kernel/hostname",
    "sys/kernel/ns_last_pid",
    "sys/kernel/randomize_va_space",
    "sys/user/max_user_namespaces",
    "sys/vm/overcommit_memory",
    "sysrq-trigger",
)
CALLS: dict[str, tuple[object, ...]] = {
    "acct": (0,),
    "add_key": (b"user", b"k", b"v", 1, -3),
    "bpf": (0, struct.pack("<4I", 2, 4, 4, 1).ljust(128, b"\0"), 128),
    "delete_module": (b"no_such_module", 0),
    "fanotify_init": (0, 0),
    "fsopen": (b"tmpfs", 0),
    "io_setup": (1, (ctypes.c_long * 1)()),
    "io_uring_setup": (4, (ctypes.c_char * 256)()),
    "keyctl": (0, -3, 1),
    "lookup_dcookie": (0, 0, 0),
    "memfd_secret": (0,),
    "open_tree": (-100, b"/", 1),
    "perf_event_open": (struct.pack("<2I", 1, 128).ljust(128, b"\0"), 0, -1, -1, 0),
    "quotactl": (0x80000100, 0, 0, 0),
    "request_key": (b"user", b"k", 0, -3),
    "setdomainname": (b"(none)", 6),
    "swapoff": (b"/nonexistent",),
    "sync": (),
    "syslog": (3, (ctypes.c_char * 64)(), 64),
    "userfaultfd": (1,),
    "vhangup": (),
}
"""Each would work for root, or fail for another reason than a lack of rights."""
NEVER_OUTSIDE = ("vhangup", "acct", "setdomainname")
SHELL_CODE = {
    "32-bit call": b"\xb8\x14\x00\x00\x00\xcd\x80\xc3",
    "x32 call": b"\xb8\x27\x00\x00\x40\x0f\x05\xc3",
}
"""``getpid`` by ``int 0x80``, and by its number in the x32 convention."""
CLONE3_ARGS = struct.pack("<11Q", NAMESPACES["user"], 0, 0, 0, signal.SIGCHLD, *[0] * 6)
HELPERS = (
    ("su", "-c", "true"),
    ("mount", "-t", "tmpfs", "none", "/tmp"),
    ("umount", "/dev/shm"),
    ("bwrap", "--bind", "/", "/", "true"),
    ("bwrap", "--unshare-user", "--bind", "/", "/", "true"),
    ("unshare", "--user", "true"),
    ("nsenter", "--target", "1", "--mount", "true"),
    ("newuidmap", "{self}", "0", "0", "1"),
    ("fusermount3", "-u", "/tmp"),
    ("setpriv", "--reuid=0", "true"),
    ("chroot", "/", "true"),
    ("ip", "link", "set", "lo", "down"),
)


def main() -> None:
    """Try everything."""
    facts: dict[str, Any] = json.loads(Path(sys.argv[1]).read_text())
    outside = sys.argv[2:] == ["outside"]
    targets = facts.get("targets") or {
        "environment": find_process("rce_container.environment"),
        "node fork server": find_process("rce_container.forkserver.nodes"),
        "holder": 1,
    }
    attacks = {**processes(targets), **calls(outside), **limits(), **addresses(facts)}
    if not outside:
        attacks |= {**files(), **rights(), **signals(facts), **games()}
    print(json.dumps({"targets": targets, "results": attempt_all(attacks)}), flush=True)


def processes(targets: dict[str, int]) -> dict[str, Attack]:
    """Look into others, and take what is theirs."""
    found: dict[str, Attack] = {}
    for who, pid in targets.items():
        for name in INSIDES:
            found[f"{name} of {who}"] = partial(_read, f"/proc/{pid}/{name}")
        for name in LINKS:
            found[f"{name} of {who}"] = partial(_stat, f"/proc/{pid}/{name}")
        found |= {
            f"descriptor of {who}": partial(_open_any, f"/proc/{pid}/fd"),
            f"file mapped by {who}": partial(_open_any, f"/proc/{pid}/map_files"),
            f"ptrace of {who}": partial(system, "ptrace", 0x4206, pid, 0, 0),
            f"process_vm_readv of {who}": partial(_touch_memory, "process_vm_readv", pid),
            f"process_vm_writev of {who}": partial(_touch_memory, "process_vm_writev", pid),
            f"process_madvise of {who}": partial(_advise, pid),
            f"pidfd_getfd of {who}": partial(_take_fd, pid),
            f"kcmp of {who}": partial(system, "kcmp", os.getpid(), pid, 1, 0, 0),
        }
    return found


def calls(outside: bool) -> dict[str, Attack]:
    """System calls that make or break walls."""
    found: dict[str, Attack] = {}
    for kind, flag in NAMESPACES.items():
        found[f"unshare {kind}"] = partial(system, "unshare", flag)
        found[f"clone {kind}"] = partial(_clone, flag)
    found["clone3"] = partial(_clone3)
    for name in NS_FILES:
        found[f"setns {name}"] = partial(_join, name)
    found["chroot"] = partial(system, "chroot", b"/usr")
    found["name_to_handle_at"] = partial(_handle)
    for name, arguments in CALLS.items():
        if not (outside and name in NEVER_OUTSIDE):
            found[name] = partial(system, name, *arguments)
    for name, code in SHELL_CODE.items():
        found[name] = partial(_execute, code)
    for family, words in {
        "packet": (17, 3, 0),
        "raw": (2, 3, 1),
        "alg": (38, 5, 0),
        "vsock": (40, 1, 0),
    }.items():
        found[f"{family} socket"] = partial(_socket, *words)
    for number, name in {2: "unused", 9: "audit", 15: "uevent", 16: "generic"}.items():
        found[f"netlink {name}"] = partial(_socket, 16, 3, number)
    return found


def limits() -> dict[str, Attack]:
    """What machines have one of for all: it must not be there for the asking."""
    return {
        "real time": partial(os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(1)),
        "nice": partial(os.setpriority, os.PRIO_PROCESS, 0, -5),
        "terminals": partial(_open_many, "/dev/ptmx", 100),
        "inotify": partial(_watch_many, 100),
        "huge pages": partial(_map_huge, 0x40022),
        "huge memfd": partial(system, "memfd_create", b"x", 4),
        "lease": partial(_lease),
        "waiting signals": partial(_queue_signals, 20_000),
        "message queues": partial(_make_queues, 60),
    }


def addresses(facts: dict[str, Any]) -> dict[str, Attack]:
    """Sockets of the machine."""
    found: dict[str, Attack] = {
        f"{kind} socket of the machine": partial(_connect, socket.AF_UNIX, address)
        for kind, address in facts["unix"].items()
    }
    found["loopback of the machine"] = partial(_connect, socket.AF_INET, ("127.0.0.1", facts["port"]))
    return found


def files() -> dict[str, Attack]:
    """Files that lead out, and programs with rights of their own."""
    found: dict[str, Attack] = {
        f"write {name}": partial(_write, f"/proc/{name}", "1") for name in PROTECTED_SETTINGS
    }
    for path in ("/etc/passwd", "/usr/x", "/x", "/run/x", "/dev/x", "/opt/rce/bundles/x", __file__):
        found[f"write {'package' if path == __file__ else path}"] = partial(_write, path, "")
    for kind in ("cgroup", "cgroup2", "proc", "sysfs", "tmpfs", "devtmpfs", "overlay", "fuse"):
        found[f"mount {kind}"] = partial(_mount, b"none", b"/tmp", kind.encode(), 0)
    found |= {
        "mount bind": partial(_mount, b"/usr", b"/tmp", b"", 4096),
        "remount /usr": partial(_mount, b"none", b"/usr", b"", 4096 | 32),
        "remount home": partial(_mount, b"none", b"/home/rce", b"", 32),
        "unmount /proc/sys": partial(system, "umount2", b"/proc/sys", 2),
        "pivot_root": partial(system, "pivot_root", b"/tmp", b"/tmp"),
        "device": partial(os.mknod, "/tmp/device", stat.S_IFBLK | 0o666, os.makedev(254, 0)),
        "memory device": partial(os.mknod, "/tmp/mem", stat.S_IFCHR | 0o666, os.makedev(1, 1)),
        "hard link to the machine's": partial(os.link, "/usr/bin/env", "/tmp/env"),
        "programs run with their owner's rights": partial(_set_user_id),
        "modules of the environment": lambda: " ".join(_writable_imports()) or "none",
        "cgroup files": partial(os.listdir, "/sys/fs/cgroup"),
        "controlling terminal": partial(os.open, "/dev/tty", os.O_RDWR),
        "type ahead": partial(fcntl.ioctl, 0, termios.TIOCSTI, b"x"),
    }
    for words in HELPERS:
        found[f"run {' '.join(words)}"] = partial(_run, words)
    return found


def rights() -> dict[str, Attack]:
    """Become somebody."""
    return {
        "setuid": partial(os.setuid, 0),
        "setgid": partial(os.setgid, 0),
        "setgroups": partial(os.setgroups, [0]),
        "user map": partial(_write, "/proc/self/uid_map", "0 0 1"),
        "capset": partial(
            system, "capset", (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)(*[0xFFFFFFFF] * 6)
        ),
        "ambient": partial(system, "prctl", 47, 2, 21, 0, 0),
        "secure bits": partial(system, "prctl", 28, 0, 0, 0, 0),
        "no_new_privs": lambda: f"stays {libc.prctl(39, 0, 0, 0, 0)}",
        "seccomp": partial(system, "prctl", 22, 0, 0, 0, 0),
        "hard limit": partial(_raise_limit),
        "core": partial(resource.setrlimit, resource.RLIMIT_CORE, (1 << 20, 1 << 20)),
        "oom score": partial(_write, "/proc/self/oom_score_adj", "0"),
        "credentials": partial(_forge),
    }


def signals(facts: dict[str, Any]) -> dict[str, Attack]:
    """Reach processes outside."""
    outside = {f"signal {who}": partial(os.kill, pid, 0) for who, pid in facts["pids"].items()}
    limits_of = {f"rlimit of {who}": partial(_set_limit, pid) for who, pid in facts["pids"].items()}
    return {**outside, **limits_of}


def games() -> dict[str, Attack]:
    """Names and links that could confuse who reads and removes what containers leave."""
    return {
        "file with a strange name": partial(_write, "/home/rce/..\n*$(touch x)`", ""),
        "link to the machine": partial(os.symlink, "/etc/shadow", "/home/rce/shadow"),
        "fifo": partial(os.mkfifo, "/home/rce/pipe"),
        "closed folder": partial(_closed_folder),
        "logs": lambda: " ".join(os.listdir("/var/log/rce")) or "nothing",
    }


def _read(path: str) -> None:
    with open(path, "rb") as file:
        if path.endswith("/mem"):
            file.seek(_some_address(path.replace("/mem", "/maps")))
        if not file.read(16):
            raise PermissionError(1, "nothing is said")


def _stat(path: str) -> None:
    os.stat(path)


def _open_any(folder: str) -> None:
    os.close(os.open(f"{folder}/{os.listdir(folder)[0]}", os.O_RDONLY | os.O_NONBLOCK))


def _some_address(maps: str) -> int:
    return int(Path(maps).read_text().partition("-")[0], 16)


def _touch_memory(call: str, pid: int) -> int:
    class Piece(ctypes.Structure):
        _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))

    buffer = ctypes.create_string_buffer(16)
    try:
        address = _some_address(f"/proc/{pid}/maps")
    except OSError:
        address = 0x400000
    here, there = Piece(ctypes.addressof(buffer), 16), Piece(address, 16)
    return system(call, pid, ctypes.byref(here), 1, ctypes.byref(there), 1, 0)


def _advise(pid: int) -> int:
    fd = os.pidfd_open(pid)
    return system("process_madvise", fd, (ctypes.c_uint64 * 2)(0x400000, 4096), 1, 21, 0)


def _take_fd(pid: int) -> int:
    return system("pidfd_getfd", os.pidfd_open(pid), 0, 0)


def _clone(flag: int) -> int:
    pid = system("clone", flag | signal.SIGCHLD, 0, 0, 0, 0)
    if pid == 0:
        os._exit(0)
    return pid


def _clone3() -> int:
    pid = system("clone3", CLONE3_ARGS, len(CLONE3_ARGS))
    if pid == 0:
        os._exit(0)
    return pid


def _join(name: str) -> int:
    with open(f"/proc/self/ns/{name}") as file:
        return system("setns", file.fileno(), 0)


def _handle() -> int:
    handle = ctypes.create_string_buffer(struct.pack("<Ii", 128, 0), 136)
    return system("name_to_handle_at", -100, b"/usr/bin/env", handle, ctypes.byref(ctypes.c_int()), 0)


def _execute(code: bytes) -> str:
    memory = mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    memory.write(code)
    function = ctypes.CFUNCTYPE(ctypes.c_int)(ctypes.addressof(ctypes.c_char.from_buffer(memory)))
    return "runs" if function() == os.getpid() else "is not there"


def _socket(family: int, kind: int, protocol: int) -> None:
    socket.socket(family, kind, protocol).close()


def _open_many(path: str, count: int) -> str:
    for number in range(count):
        try:
            os.open(path, os.O_RDWR | os.O_NOCTTY)
        except OSError:
            return f"limited to {number}"
    return "unlimited"


def _watch_many(count: int) -> str:
    for number in range(count):
        if libc.inotify_init() < 0:
            return f"limited to {number}"
    return "unlimited"


def _map_huge(flags: int) -> int:
    return system("mmap", 0, 2 << 20, 3, flags, -1, 0)


def _lease() -> int:
    path = Path(__file__)
    with path.open("rb") as file:
        return fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_RDLCK)


def _queue_signals(count: int) -> str:
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGRTMIN})
    info = struct.pack("<iiiQ", signal.SIGRTMIN, 0, -1, 0).ljust(128, b"\0")
    for number in range(count):
        try:
            system("rt_sigqueueinfo", os.getpid(), int(signal.SIGRTMIN), info)
        except OSError:
            return "limited" if number else "refused"
    return "unlimited"


def _make_queues(count: int) -> str:
    for number in range(count):
        try:
            system("mq_open", b"hostile%d" % number, os.O_CREAT | os.O_RDWR, 0o600, 0)
        except OSError:
            return "limited"
        finally:
            with_name = b"hostile%d" % number
            libc.syscall(_seccomp_number("mq_unlink"), with_name)
    return "unlimited"


def _seccomp_number(name: str) -> int:
    return int(ctypes.CDLL("libseccomp.so.2").seccomp_syscall_resolve_name(name.encode()))


def _connect(family: int, address: Any) -> None:
    with socket.socket(family) as sock:
        sock.settimeout(2)
        sock.connect(address)


def _write(path: str, text: str) -> None:
    with open(path, "w") as file:
        file.write(text)


def _mount(source: bytes, target: bytes, kind: bytes, flags: int) -> int:
    return system("mount", source, target, kind, flags, 0)


def _set_user_id() -> str:
    """Whether any program of the system runs with its owner's rights where it is."""
    for folder in map(Path, ("/usr/bin", "/usr/sbin", "/usr/lib")):
        for path in folder.iterdir():
            is_set = path.is_file() and path.stat().st_mode & (stat.S_ISUID | stat.S_ISGID)
            if is_set and not os.statvfs(path).f_flag & os.ST_NOSUID and not libc.prctl(39, 0, 0, 0, 0):
                return str(path)
    return "none"


def _writable_imports() -> Iterator[str]:
    """Folders of modules in which something can be put, or that can be put somewhere else."""
    for entry in filter(None, (*sys.path, sys.prefix, sys.executable)):
        path = Path(entry)
        if path.is_relative_to(Path(__file__).parent):
            continue
        for folder in (path, *path.parents[:-1]):
            if str(folder) in ("/tmp", "/home/rce", "/home"):
                continue
            try:
                folder.rename(folder.with_name(f"{folder.name}.old"))
            except OSError:
                pass
            else:
                yield f"renamed:{folder}"
                folder.with_name(f"{folder.name}.old").rename(folder)
            if folder.is_dir() and os.access(folder, os.W_OK):
                yield f"writable:{folder}"


def _run(words: tuple[str, ...]) -> str:
    argv = [word.replace("{self}", str(os.getpid())) for word in words]
    try:
        done = subprocess.run(argv, stdin=subprocess.DEVNULL, capture_output=True, timeout=4, check=False)
    except FileNotFoundError:
        return "is not there"
    return "works" if done.returncode == 0 else "fails"


def _raise_limit() -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard + 1, hard + 1))


def _forge() -> None:
    ours, _ = socket.socketpair(socket.AF_UNIX)
    ours.sendmsg([b"x"], [(socket.SOL_SOCKET, socket.SCM_CREDENTIALS, struct.pack("iII", 1, 0, 0))])


def _set_limit(pid: int) -> None:
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (10, 10))


def _closed_folder() -> None:
    os.makedirs("/home/rce/closed/inner")
    os.chmod("/home/rce/closed", 0)


if __name__ == "__main__":
    main()
