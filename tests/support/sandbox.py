"""``python -m support.sandbox FOLDER RUNTIME look|two``: makes containers and prints what nodes see and do.

Runs as whatever user it is started by, with a manager of its own. What it prints is JSON: what the machine
sees of the container, and what each node said of itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from pathlib import Path
from typing import Any

from rce.control.model import EndpointState
from rce.model.specs import NodeSpec
from rce_container.environment import proc
from support.containers import Machine, until

BOX = "user/box"
KINDS = ("user", "mnt", "pid", "net", "ipc", "uts", "cgroup")
NODE = """
import ctypes, errno, json, os, resource, socket, sys

libc = ctypes.CDLL(None, use_errno=True)

def call(name, *arguments):
    ctypes.set_errno(0)
    result = getattr(libc, name)(*arguments)
    return 0 if result >= 0 else ctypes.get_errno()

def attempt(act, *arguments):
    try:
        found = act(*arguments)
    except OSError as error:
        return error.errno
    if hasattr(found, "close"):
        found.close()
    return 0

def lines(path):
    return open(path).read().splitlines()

def fill(folder):
    written, piece = 0, b"x" * (1 << 20)
    try:
        with open(folder + "/fill", "wb", buffering=0) as file:
            while written < 64 << 20:
                written += file.write(piece)
    except OSError as error:
        found = error.errno
    else:
        found = 0
    os.unlink(folder + "/fill")
    return [written, found]

def create(folder):
    os.mkdir(folder + "/many")
    try:
        for number in range(100_000):
            open(f"{folder}/many/{number}", "w").close()
    except OSError as error:
        return error.errno

environment = os.getppid()
print(json.dumps({
    "fds": {fd: os.readlink("/proc/self/fd/" + fd) for fd in os.listdir("/proc/self/fd")
            if os.path.exists("/proc/self/fd/" + fd)},
    "uid": os.getresuid(), "gid": os.getresgid(), "groups": os.getgroups(),
    "status": dict(line.split(":", 1) for line in lines("/proc/self/status")),
    "uid_map": lines("/proc/self/uid_map")[0].split(),
    "env": dict(os.environ),
    "shown": dict(w.split("=", 1) for w in open("/proc/self/environ").read().split(chr(0)) if "=" in w),
    "cmdline": open("/proc/self/cmdline").read().split(chr(0)),
    "mounts": [line.split(" - ") for line in lines("/proc/self/mountinfo")],
    "namespaces": {kind: os.readlink("/proc/self/ns/" + kind) for kind in sys.argv[1].split(",")},
    "pids": sorted(int(name) for name in os.listdir("/proc") if name.isdigit()),
    "core": resource.getrlimit(resource.RLIMIT_CORE)[0],
    "size": {path: os.statvfs(path).f_blocks * os.statvfs(path).f_frsize
             for path in (os.environ["HOME"], "/tmp", "/dev/shm")},
    "home": os.stat(os.environ["HOME"]).st_mode & 0o7777, "cwd": os.getcwd(),
    "full": fill(os.environ["HOME"]), "many": create(os.environ["HOME"]),
    "writable": [path for path in ("/", "/etc", "/dev", "/run", "/usr", "/var/log", "/proc/sys", "/home")
                 if os.access(path, os.W_OK)],
    "exists": [path for path in ("/sys", "/root/.ssh", "/var/log/rce", "/var/lib", sys.argv[2])
               if os.path.exists(path) and os.listdir(path)],
    "calls": {
        "unshare user": call("unshare", 0x10000000), "unshare mount": call("unshare", 0x20000),
        "mount": call("mount", b"none", b"/tmp", b"tmpfs", 0, None), "umount": call("umount2", b"/tmp", 2),
        "ptrace": call("ptrace", 16, environment, 0, 0), "chroot": call("chroot", b"/tmp"),
        "keyctl": call("syscall", 250, 0, -3, 1, 0, 0), "bpf": call("syscall", 321, 0, 0, 0),
        "setns": call("setns", os.open("/proc/self/ns/uts", os.O_RDONLY), 0),
        "sethostname": call("sethostname", b"x", 1), "setuid": call("setuid", 0),
        "kill holder": attempt(os.kill, 1, 9), "nice": attempt(os.setpriority, os.PRIO_PROCESS, 0, -5),
        "vsock": attempt(socket.socket, 40, 1), "raw": attempt(socket.socket, socket.AF_INET, 3, 1),
        "packet": attempt(socket.socket, socket.AF_PACKET, 3), "names": attempt(socket.if_nameindex),
    },
    "environment": {
        **{name: attempt(open, f"/proc/{environment}/{name}") for name in ("mem", "environ", "maps")},
        **{name: attempt(os.listdir, f"/proc/{environment}/{name}") for name in ("fd", "root/", "cwd/")},
    },
    "written": {path: attempt(open, path, "w") for path in
                ("/proc/sys/kernel/hostname", "/etc/passwd", "/dev/x", __file__)},
    "hidden": {path: os.path.getsize(path) for path in ("/proc/keys", "/proc/kallsyms", "/proc/timer_list")
               if os.path.exists(path) and open(path).read()},
    "forked": "rce_container.forkserver" in sys.modules,
}), flush=True)
import time
time.sleep(600)
"""


async def look(folder: Path, runtime: str, home_bytes: int) -> dict[str, Any]:
    """Make a container with a forked node and an executed one, and let both say what they can do."""
    machine = Machine(folder, runtime, home_bytes=home_bytes)
    nodes = machine.packages / "own" / "nodes"
    (nodes / "forked.py").write_text(NODE)
    (nodes / "executed").write_text(f"#!{sys.executable}\n{NODE}")
    (nodes / "executed").chmod(0o755)
    arguments = f"{','.join(KINDS)} {folder}/state"
    found: dict[str, Any] = {"detail": machine.runtime.detail}
    try:
        async with machine.engine():
            for exe in ("forked.py", "executed"):
                node = NodeSpec(tag="node", pkg="own", exe=exe, args=arguments)
                await machine.put(BOX, nodes=(node,))
                said = await machine.log_holds(BOX, "node", "}\n")
                await until(
                    lambda: (node := machine.node(BOX, "node")) is not None and node.pid,
                    what="the node's process is told",
                )
                seen = json.loads(next(line for line in said.splitlines() if line.startswith("{")))
                found[exe.partition(".")[0]] = {**seen, "outside": outside(machine)}
                await machine.drop(BOX)
    finally:
        machine.tidy()
    return found


def outside(machine: Machine) -> dict[str, Any]:
    """What the machine sees of the container that runs."""
    (incarnation,) = machine.manager._incarnations.values()
    handle = incarnation.handle
    assert handle.environment is not None
    status = Path(f"/proc/{handle.environment.pid}/status").read_text().splitlines()
    fields = dict(line.split(":", 1) for line in status)
    namespaces = {kind: str(Path(f"/proc/self/ns/{kind}").readlink()) for kind in KINDS}
    return {
        "uid": int(fields["Uid"].split()[0]),
        "status": fields,
        "namespaces": namespaces,
        "logs": incarnation.folder.logs.stat().st_uid,
        "oom": [
            int(Path(f"/proc/{pid}/oom_score_adj").read_text()) for pid in incarnation.node_pids.values()
        ],
        "members": [process.pid for process in handle.members(proc.table())],
    }


async def two(folder: Path, runtime: str) -> dict[str, Any]:
    """Make two containers, let the manager die, and make a third: whose users are they?"""
    machine = Machine(folder, runtime)

    def users() -> dict[str, int]:
        incarnations = machine.manager._incarnations.values()
        return {one.id: _uid(one.handle.environment.pid) for one in incarnations if one.handle.environment}

    async def running(id_: str) -> None:
        await machine.put(id_)
        await until(lambda: (s := machine.status(id_)) is not None and s.state is EndpointState.RUNNING)

    try:
        async with machine.managed():
            for id_ in ("user/one", "user/two"):
                await running(id_)
            before = users()
        async with machine.engine():
            await running("user/three")
            after = users()
    finally:
        machine.tidy()
    return {"before": before, "after": after}


def _uid(pid: int) -> int:
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.partition("Uid:")[2].split()[0])


async def main() -> None:
    folder, runtime, what = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
    folder.mkdir()
    found = await (look(folder, runtime, int(sys.argv[4])) if what == "look" else two(folder, runtime))
    with contextlib.suppress(OSError):
        print(json.dumps(found))  # noqa: T201 - for the test that started it


if __name__ == "__main__":
    asyncio.run(main())
