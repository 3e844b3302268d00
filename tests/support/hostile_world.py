"""``python -m support.hostile_world FOLDER RUNTIME attack|starve NAME...``: gives a machine to somebody hostile.

Runs as whatever user it is started by, with a manager of its own, a neighbour of another user beside the
attacker, and sockets of the machine that nobody inside should reach. Prints, as JSON, what became of it all.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import resource
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

from rce.control.model import LinkSpec, NodeSpec, Resources
from rce_container.environment import proc
from support.containers import ECHO, ECHO_INTERFACES, MACHINE, Machine, Peer, container, until
from support.persons import SECRET

HOSTILE = Path(__file__).parent / "hostile"
NEIGHBOUR = "calmneighbour/quietbox"
ATTACKER = "mallory/box"
TOKEN = "thetokenofthislink"
OTHER_TOKEN = "thetokenofanotherlink"
TREASURE = "whattheneighbourkeeps"
KEEPER = (
    f"import time\ntreasure = '{TREASURE[::-1]}'[::-1]\n"
    "open('/home/rce/treasure', 'w').write(treasure)\n"
    "open('/dev/shm/treasure', 'w').write(treasure)\n"
    "print('kept', flush=True)\n"
    "time.sleep(600)\n"
)
MB = 1 << 20


def link(token: str) -> tuple[LinkSpec, ...]:
    """A link that nobody dials, with a token that is a secret."""
    return (LinkSpec(id=token[-5:], peer="user/nobody", token=token, dial=False),)


class World:
    """A machine with a neighbour on it."""

    def __init__(self, folder: Path, runtime: str) -> None:
        self.folder = folder
        self.machine = Machine(folder, runtime, home_bytes=32 * MB)
        shutil.copytree(
            HOSTILE, self.machine.packages / "hostile", ignore=shutil.ignore_patterns("__pycache__")
        )
        (self.machine.packages / "own" / "nodes" / "keep.py").write_text(KEEPER)
        self.facts = self.machine.packages / "hostile" / "facts.json"

    @contextlib.asynccontextmanager
    async def running(self, **options: Any) -> AsyncIterator[None]:
        """Run the manager and the neighbour."""
        async with self.machine.engine(**options):
            await self.machine.manager.handle(_put_neighbour())
            await self.machine.log_holds(NEIGHBOUR, "keep", "kept")
            yield

    def environment(self, id_: str) -> proc.Process:
        """The environment of a container."""
        (unit,) = (unit for unit in self.machine.manager._units.values() if unit.id == id_)
        assert unit.handle.environment is not None
        return unit.handle.environment

    async def say(self, id_: str, node: str) -> Any:
        """Wait for a line of JSON from a node."""
        text = await self.machine.log_holds(id_, node, "}\n")
        return json.loads(next(line for line in text.splitlines() if line.startswith("{")))


def _put_neighbour() -> Any:
    from rce.control.messages import Put

    spec = container(
        NEIGHBOUR,
        1,
        nodes=(ECHO, NodeSpec(tag="keep", pkg="own", exe="keep.py")),
        interfaces=ECHO_INTERFACES,
        peer="user/robot",
    )
    return Put(endpoint=_with(spec, links=(*spec.links, *link(OTHER_TOKEN))))


def _with(spec: Any, **parts: Any) -> Any:
    import msgspec

    return msgspec.structs.replace(spec, **parts)


# Leaving and spying


async def attack(folder: Path, runtime: str) -> dict[str, Any]:
    """Let nodes try to leave and to spy, by fork and by execution, and the same outside."""
    world = World(folder, runtime)
    machine = world.machine
    found: dict[str, Any] = {}
    try:
        with Bait(folder) as bait:
            async with world.running():
                _write_facts(world, bait)
                before = world.environment(NEIGHBOUR)
                nodes = machine.packages / "hostile" / "nodes"
                executed = nodes / "executed"
                executed.write_text(f"#!{sys.executable}\n{(nodes / 'leave.py').read_text()}")
                executed.chmod(0o755)
                for exe in ("leave.py", "executed", "spy.py"):
                    tag = exe.partition(".")[0]
                    node = NodeSpec(tag=tag, pkg="hostile", exe=exe, args=str(world.facts))
                    await machine.put(ATTACKER, nodes=(node,), links=link(TOKEN))
                    found[tag] = await world.say(ATTACKER, tag)
                    found["memory"] = search_from_outside(world)
                    await machine.drop(ATTACKER)
                found["outside"] = _try_outside(world)
                found["neighbour lives"] = world.environment(NEIGHBOUR) == before
                found["folder"] = str(folder)
    finally:
        machine.tidy()
    return found


class Bait:
    """Sockets of the machine that nobody inside should reach."""

    def __init__(self, folder: Path) -> None:
        self.abstract = f"\0rce-hostile-{os.getpid()}"
        self.path = str(folder / "bait.sock")
        self._sockets = [socket.socket(family) for family in (socket.AF_UNIX, socket.AF_UNIX, socket.AF_INET)]
        self.port = 0

    def __enter__(self) -> Bait:
        for sock, address in zip(self._sockets, (self.abstract, self.path, ("127.0.0.1", 0)), strict=True):
            sock.bind(address)
            sock.listen()
        self.port = self._sockets[2].getsockname()[1]
        return self

    def __exit__(self, *_: object) -> None:
        for sock in self._sockets:
            sock.close()


def _write_facts(world: World, bait: Bait) -> None:
    (unit,) = world.machine.manager._units.values()
    environment = world.environment(NEIGHBOUR)
    shim = unit.handle.process.pid
    facts = {
        "unix": {
            "abstract": bait.abstract,
            "bound": bait.path,
            "control": str(unit.folder.control_socket),
            "link": str(unit.folder.link_socket),
            "docker": "/run/docker.sock",
            "podman": "/run/podman/podman.sock",
            "bus": "/run/dbus/system_bus_socket",
            "systemd": "/run/systemd/private",
            "journal": "/run/systemd/journal/stdout",
        },
        "port": bait.port,
        "pids": {"manager": os.getpid(), "shim": shim, "neighbour": environment.pid},
        "paths": {
            "shadow": "/etc/shadow",
            "root's home": "/root/.",
            "homes": "/home/..data" if Path("/home/..data").exists() else str(Path.home() / ".profile"),
            "state": str(world.folder / "state"),
            "logs": str(world.folder / "state" / "logs"),
            "neighbour's folder": str(unit.folder.path),
            "users": "/run/rce/uids",
            "neighbour's process": f"/proc/{environment.pid}/status",
            "treasure": "/home/rce/treasure",
            "shared treasure": "/dev/shm/treasure",
            "machine's packages": "/var/lib/dpkg/status",
        },
        "backwards": {
            name: text[::-1]
            for name, text in {
                "secret": SECRET,
                "token": TOKEN,
                "other token": OTHER_TOKEN,
                "neighbour": NEIGHBOUR.partition("/")[0],
                "treasure": TREASURE,
            }.items()
        },
    }
    world.facts.write_text(json.dumps(facts))


def _try_outside(world: World) -> dict[str, str]:
    """The attacks that hurt nobody, as the same person, without a container."""
    with _sleeper() as victim:
        facts = json.loads(world.facts.read_text())
        facts["targets"] = {"environment": victim}
        path = world.folder / "outside.json"
        path.write_text(json.dumps(facts))
        leave = HOSTILE / "nodes" / "leave.py"
        argv = [sys.executable, str(leave), str(path), "outside"]
        done = subprocess.run(argv, capture_output=True, text=True, check=True)
    results = json.loads(done.stdout.splitlines()[-1])["results"]
    assert isinstance(results, dict)
    return results


@contextlib.contextmanager
def _sleeper() -> Iterator[int]:
    """A process of the same user to attack."""
    process = subprocess.Popen([sys.executable, "-c", "print(flush=True); input()"], stdin=-1, stdout=-1)
    assert process.stdout is not None
    process.stdout.readline()
    yield process.pid
    process.communicate()


def search_from_outside(world: World) -> dict[str, list[str]]:
    """Search the memory of all that takes part, as far as this person may: who knows what?"""
    pids = {"nursery": world.machine.runtime._nursery.pid}  # type: ignore[attr-defined]
    inside = world.environment(ATTACKER)
    pids["environment"] = inside.pid
    for process in proc.descendants(inside.pid, proc.table()):
        with contextlib.suppress(FileNotFoundError):  # what the node started is ending
            words = Path(f"/proc/{process.pid}/cmdline").read_bytes().split(b"\0")
            if b"rce_container.nursery.cradle" in words:
                pids["cradle"] = process.pid
    texts = {"secret": SECRET, "token": TOKEN, "other token": OTHER_TOKEN, "neighbour": NEIGHBOUR}
    found = {}
    for who, pid in pids.items():
        with contextlib.suppress(PermissionError):
            found[who] = sorted(_holds(pid, texts))
    return found


def _holds(pid: int, texts: dict[str, str]) -> set[str]:
    found = set()
    with open(f"/proc/{pid}/mem", "rb", buffering=0) as memory:
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            fields = line.split()
            begin, end = (int(text, 16) for text in fields[0].split("-"))
            with contextlib.suppress(OSError, OverflowError):
                memory.seek(begin)
                data = memory.read(end - begin)
                found |= {name for name, text in texts.items() if text.encode() in data}
    variables = Path(f"/proc/{pid}/environ").read_bytes()
    return found | {f"{name} in variables" for name, text in texts.items() if text.encode() in variables}


async def main() -> None:
    folder, runtime, what = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
    folder.mkdir()
    found = await {"attack": attack}[what](folder, runtime)
    print(json.dumps(found))  # noqa: T201 - for the test that started it


if __name__ == "__main__":
    asyncio.run(main())
