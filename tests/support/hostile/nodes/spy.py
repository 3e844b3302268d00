"""Looks around in the container: prints, as JSON, what it could learn of the machine and of others.

``spy.py FILE``: a file of facts, in JSON. What is searched for in memory stands there backwards, so that
nobody finds the question.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import re
import socket
import struct
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from attempts import attempt_all, system

SYSTEM_FILES = (
    "acpi",
    "cmdline",
    "config.gz",
    "diskstats",
    "driver",
    "interrupts",
    "kallsyms",
    "kcore",
    "key-users",
    "keys",
    "kmsg",
    "kpagecount",
    "mdstat",
    "modules",
    "partitions",
    "sched_debug",
    "schedstat",
    "softirqs",
    "swaps",
    "timer_list",
    "vmallocinfo",
)
"""What the kernel tells in ``/proc`` of the machine and nobody in a container needs."""
Needle = re.Pattern[bytes]
POINTER = re.compile(rb"\bffff[0-9a-f]{12}\b")


def main() -> None:
    """Look at everything."""
    facts: dict[str, Any] = json.loads(Path(sys.argv[1]).read_text())
    needles = {name: _pattern(text) for name, text in facts["backwards"].items()}
    attacks: dict[str, Callable[[], object]] = {
        **{f"file {name}": partial(_find, path) for name, path in facts["paths"].items()},
        **{f"/proc/{name}": partial(_content, f"/proc/{name}") for name in SYSTEM_FILES},
        "kernel log": lambda: system("syslog", 3, ctypes.create_string_buffer(64), 64),
        "kernel pointers": _pointers,
        "processes": _processes,
        "interfaces": lambda: " ".join(name for _, name in socket.if_nameindex()),
        "addresses": _addresses,
        "routes": lambda: str(len(Path("/proc/net/route").read_text().splitlines()) - 1),
        "unix sockets": lambda: " ".join(sorted(_bound_sockets())) or "none",
        "ipc": _ipc,
        "locks": lambda: str(len(Path("/proc/locks").read_text().splitlines())),
        "machine's variables": lambda: _variables(needles["secret"]),
        "machine's words": lambda: _search_files(needles),
        "own memory": lambda: _search_memory(needles),
        "own memory with something in it": lambda: _plant(facts["backwards"]["treasure"], needles),
        "mount sources": lambda: "\n".join(_sources()),
        "host name": socket.gethostname,
        "cgroup": lambda: Path("/proc/self/cgroup").read_text().strip(),
        "sysfs": partial(_find, "/sys/kernel"),
    }
    print(json.dumps(attempt_all(attacks)), flush=True)


def _pattern(backwards: str) -> Needle:
    """What finds a text, without holding it anywhere in one piece."""
    return re.compile("".join(f"[{letter}]" for letter in reversed(backwards)).encode())


def _find(path: str) -> None:
    os.stat(path)


def _content(path: str) -> str:
    if os.path.isdir(path):
        return "something" if os.listdir(path) else "nothing"
    with open(path, "rb") as file:
        return "something" if file.read(1) else "nothing"


def _pointers() -> str:
    for name in ("kallsyms", "modules", "net/unix", "net/tcp", "self/stat", "self/wchan", "timer_list"):
        with contextlib.suppress(OSError):
            if POINTER.search(Path(f"/proc/{name}").read_bytes()):
                return name
    return "none"


def _processes() -> str:
    names = set()
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            names.add((path / "comm").read_text().strip())
    return " ".join(sorted(names))


def _addresses() -> str:
    """Ask the kernel, by netlink, for all addresses of network interfaces."""
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, 0) as sock:
        sock.settimeout(2)
        sock.send(struct.pack("<IHHIIB7x", 24, 22, 0x301, 1, 0, 0))
        answer = sock.recv(1 << 16)
    found = []
    while len(answer) >= 16:
        length, kind = struct.unpack_from("<IH", answer)
        if kind == 20 and answer[16] == socket.AF_INET:
            found.append(socket.inet_ntoa(answer[28:32]))
        answer = answer[max(16, length) :]
    return " ".join(found)


def _bound_sockets() -> list[str]:
    lines = Path("/proc/net/unix").read_text().splitlines()[1:]
    return [line.split()[7] for line in lines if len(line.split()) > 7]


def _ipc() -> str:
    files = ("msg", "sem", "shm")
    return str(sum(len(Path(f"/proc/sysvipc/{name}").read_text().splitlines()) - 1 for name in files))


def _variables(needle: Needle) -> str:
    for path in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            if needle.search(path.read_bytes()):
                return str(path)
    return "none"


def _search_files(needles: dict[str, Needle]) -> str:
    """Search what is told of processes and in ``/etc`` and ``/run``."""
    found = []
    for folder in ("/etc", "/run", "/tmp", "/dev/shm", "/opt/rce", "/proc/sys/kernel"):
        for parent, _, names in os.walk(folder):
            for name in names:
                with contextlib.suppress(OSError):
                    path = Path(parent, name)
                    if path.is_file() and path.stat().st_size < 1 << 20:
                        data = path.read_bytes()
                        found += [f"{path}:{what}" for what, needle in needles.items() if needle.search(data)]
    return " ".join(found) or "none"


def _search_memory(needles: dict[str, Needle]) -> str:
    """Search the memory that was inherited from the process that forked this one."""
    found = set()
    with open("/proc/self/mem", "rb", buffering=0) as memory:
        for line in Path("/proc/self/maps").read_text().splitlines():
            fields = line.split()
            if "r" not in fields[1] or fields[-1] in ("[vvar]", "[vsyscall]", "[vvar_vclock]"):
                continue
            begin, end = (int(text, 16) for text in fields[0].split("-"))
            with contextlib.suppress(OSError):
                memory.seek(begin)
                data = memory.read(end - begin)
                found |= {name for name, needle in needles.items() if needle.search(data)}
    return " ".join(sorted(found)) or "none"


def _plant(backwards: str, needles: dict[str, Needle]) -> str:
    """Know the treasure, and search for it."""
    treasure = backwards[::-1].encode()
    return _search_memory(needles) if treasure else ""


def _sources() -> set[str]:
    """The paths of the machine that mounts come from, as far as they are told."""
    lines = Path("/proc/self/mountinfo").read_text().splitlines()
    return {line.split()[3] for line in lines} - {"/"}


if __name__ == "__main__":
    main()
