"""``python -m support.hostile_world FOLDER RUNTIME WHAT``: a machine with somebody hostile on it.

Runs as whatever user it is started by, with a manager of its own, a neighbour of another user beside the
attacker, and sockets of the machine that nobody inside should reach. Prints, as JSON, what became of it all.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import mmap
import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from pathlib import Path
from typing import Any, Self, Unpack
from unittest import mock

import msgspec

from rce.control.messages import Fault, Put
from rce.control.model import EndpointState, LinkSpec, NodeState
from rce.link import LinkError
from rce.model.specs import InterfaceSpec, NodeSpec, Resources
from rce_container.environment import proc
from rce_container.runtimes.namespace import NamespaceRuntime
from rce_container.seccomp.library import FilterUnavailableError
from support.container_peers import Peer
from support.container_specs import ECHO, ECHO_INTERFACES, MACHINE, ContainerParts, container
from support.containers import Machine, ManagerOptions, until
from support.persons import SECRET

HOSTILE = Path(__file__).parent / "hostile"
MODULE = "support.hostile_world"
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
_NS_GET_OWNER_UID = 0xB704
MB = 1 << 20
MEMORY_MB = 96
PROCESSES = 60
STARTED_BESIDE = ("passing", "processors")
"""What might keep other containers from starting."""
OUTSIDE = ("anonymous", "memfd", "unix", "tcp", "tables", "zombies", "threads")
"""What may be taken without a container, for a moment, and without harm."""


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
    async def running(self, **options: Unpack[ManagerOptions]) -> AsyncIterator[None]:
        """Run the manager and the neighbour."""
        async with self.machine.engine(**options):
            await self.machine.manager.handle(_put_neighbour())
            await self.machine.log_holds(NEIGHBOUR, "keep", "kept")
            yield

    def environment(self, id_: str) -> proc.Process:
        """The environment of a container."""
        (incarnation,) = (
            incarnation
            for incarnation in self.machine.manager._incarnations.values()
            if incarnation.id == id_
        )
        assert incarnation.handle.environment is not None
        return incarnation.handle.environment

    async def say(self, id_: str, node: str) -> Any:
        """Wait for a line of JSON from a node."""
        text = await self.machine.log_holds(id_, node, "}\n")
        return json.loads(next(line for line in text.splitlines() if line.startswith("{")))


def _put_neighbour() -> Put:
    spec = container(
        NEIGHBOUR,
        1,
        nodes=(ECHO, NodeSpec(tag="keep", pkg="own", exe="keep.py")),
        interfaces=ECHO_INTERFACES,
        peer="user/robot",
    )
    return Put(endpoint=msgspec.structs.replace(spec, links=(*spec.links, *link(OTHER_TOKEN))))


# Leaving and spying


async def attack(
    folder: Path, runtime: str, programs: Sequence[str] = ("leave.py", "executed", "spy.py")
) -> dict[str, Any]:
    """Let nodes try to leave and to spy, by fork and by execution, and the same outside."""
    world = World(folder, runtime)
    machine = world.machine
    found: dict[str, Any] = {}
    try:
        with Bait(folder) as bait:
            async with world.running():
                found["neighbour's words"] = _write_facts(world, bait)
                before = world.environment(NEIGHBOUR)
                nodes = machine.packages / "hostile" / "nodes"
                executed = nodes / "executed"
                executed.write_text(f"#!{sys.executable}\n{(nodes / 'leave.py').read_text()}")
                executed.chmod(0o755)
                for exe in programs:
                    tag = exe.partition(".")[0]
                    node = NodeSpec(tag=tag, pkg="hostile", exe=exe, args=str(world.facts))
                    await machine.put(ATTACKER, nodes=(node,), links=link(TOKEN))
                    found[tag] = await world.say(ATTACKER, tag)
                    found["memory"] = search_from_outside(world)
                    found["owner"] = owner_of_namespace(world.environment(ATTACKER).pid)
                    await machine.drop(ATTACKER)
                found["outside"] = _try_outside(world)
                found["neighbour lives"] = world.environment(NEIGHBOUR) == before
                paths = json.loads(world.facts.read_text())["paths"]
                found["there"] = [name for name, path in paths.items() if os.path.lexists(path)]
    finally:
        machine.tidy()
    return found


class Bait:
    """Sockets of the machine that an attacker inside must not reach, and a locked file.

    Its lock belongs to an open file, not to a process: the kernel tells of it in all namespaces.
    """

    def __init__(self, folder: Path) -> None:
        self.abstract = f"\0rce-hostile-{os.getpid()}"
        self.path = str(folder / "bait.sock")
        self._sockets = [socket.socket(family) for family in (socket.AF_UNIX, socket.AF_UNIX, socket.AF_INET)]
        self._locked = (folder / "locked").open("wb")
        self.port = 0

    def __enter__(self) -> Self:
        fcntl.fcntl(
            self._locked, fcntl.F_OFD_SETLK, struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
        )
        addresses: tuple[str | tuple[str, int], ...] = (self.abstract, self.path, ("127.0.0.1", 0))
        for sock, address in zip(self._sockets, addresses, strict=True):
            sock.bind(address)
            sock.listen()
        self.port = self._sockets[2].getsockname()[1]
        return self

    def __exit__(self, *_: object) -> None:
        self._locked.close()
        for sock in self._sockets:
            sock.close()


def _write_facts(world: World, bait: Bait) -> list[str]:
    """Tell the attacker where to look; returns words that would give the neighbour away."""
    (incarnation,) = world.machine.manager._incarnations.values()
    environment = world.environment(NEIGHBOUR)
    shim = incarnation.handle.process.pid
    facts = {
        "unix": {
            "abstract": bait.abstract,
            "bound": bait.path,
            "control": str(incarnation.folder.control_socket),
            "link": str(incarnation.folder.link_socket),
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
            "root's home": "/root/.bashrc",
            "configuration": "/etc/fstab",
            "state": str(world.folder / "state"),
            "logs": str(world.folder / "state" / "logs"),
            "neighbour's folder": str(incarnation.folder.path),
            "users": "/run/rce/uids",
            "neighbour's process": f"/proc/{environment.pid}/status",
            "treasure": "/home/rce/treasure",
            "shared treasure": "/dev/shm/treasure",
            "machine's packages": "/var/lib/dpkg",
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
    return [*NEIGHBOUR.split("/"), incarnation.incarnation_id]


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


def owner_of_namespace(pid: int) -> list[int]:
    """Who owns the user namespace of a process, and as whom the process runs; empty if that is not told."""
    try:
        with Path(f"/proc/{pid}/ns/user").open() as file:
            answer = fcntl.ioctl(file, _NS_GET_OWNER_UID, struct.pack("I", 0))
    except PermissionError:
        return []
    return [struct.unpack("I", answer)[0], _uid(pid)]


def _uid(pid: int) -> int:
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.partition("Uid:")[2].split()[0])


def search_from_outside(world: World) -> dict[str, list[str]]:
    """Search the memory of all that takes part, as far as this person may: who knows what?"""
    assert isinstance(world.machine.runtime, NamespaceRuntime)
    pids = {"fork server": world.machine.runtime._fork_server.pid}
    inside = world.environment(ATTACKER)
    pids["environment"] = inside.pid
    for process in proc.descendants(inside.pid, proc.table()):
        with contextlib.suppress(FileNotFoundError):  # what the node started is ending
            words = Path(f"/proc/{process.pid}/cmdline").read_bytes().split(b"\0")
            if b"rce_container.forkserver.nodes" in words:
                pids["node fork server"] = process.pid
    texts = {"secret": SECRET, "token": TOKEN, "other token": OTHER_TOKEN, "neighbour": NEIGHBOUR}
    found = {}
    for who, pid in pids.items():
        with contextlib.suppress(PermissionError):
            found[who] = sorted(_holds(pid, texts))
    return found


def _holds(pid: int, texts: dict[str, str]) -> set[str]:
    found = set()
    with Path(f"/proc/{pid}/mem").open("rb", buffering=0) as memory:
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            fields = line.split()
            begin, end = (int(text, 16) for text in fields[0].split("-"))
            with contextlib.suppress(OSError, OverflowError):
                memory.seek(begin)
                data = memory.read(end - begin)
                found |= {name for name, text in texts.items() if text.encode() in data}
    variables = Path(f"/proc/{pid}/environ").read_bytes()
    return found | {f"{name} in variables" for name, text in texts.items() if text.encode() in variables}


# Starving


def starve_outside(things: list[str]) -> dict[str, str]:
    """What stops them where no container does."""
    return {thing: _starve_outside(thing) for thing in things}


def _starve_outside(thing: str) -> str:
    argv = [sys.executable, str(HOSTILE / "nodes" / "starve.py"), thing]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            last = next(line for line in process.stdout if line.startswith("{"))
        finally:
            process.kill()
    return str(json.loads(last)["ended"])


async def starve(folder: Path, runtime: str, things: list[str]) -> dict[str, Any]:
    """Let nodes take all they can get of one thing after the other, and ask the neighbour meanwhile."""
    world = World(folder, runtime)
    machine = world.machine
    found: dict[str, Any] = {}
    try:
        async with world.running(slot_processes=PROCESSES, interrupt_timeout=0.2, cleanup_timeout=0.5):
            status = machine.status(NEIGHBOUR)
            assert status is not None
            before = world.environment(NEIGHBOUR)
            peer = Peer(MACHINE)
            await peer.wire(status.address, ECHO_INTERFACES, id_=NEIGHBOUR)
            await peer.active()
            try:
                for thing in things:
                    found[thing] = await Hunger(world, thing).suffer(peer)
            finally:
                await peer.close()
            found["neighbour lives"] = world.environment(NEIGHBOUR) == before
            found["outside"] = starve_outside([thing for thing in things if thing in OUTSIDE])
    finally:
        machine.tidy()
    return found


class Hunger:
    """What a container does that takes all of one thing, and what that does to others."""

    def __init__(self, world: World, thing: str) -> None:
        self._world = world
        self._machine = world.machine
        self._thing = thing
        self._id = f"mallory/{thing}"

    async def suffer(self, peer: Peer) -> dict[str, Any]:
        """Make the container, wait for the worst, and remove it."""
        machine, thing = self._machine, self._thing
        told, tcp, disk = len(machine.told), tcp_pages(), _disk(self._world.folder)
        node = NodeSpec(tag="hog", pkg="hostile", exe="starve.py", args=thing)
        limits = Resources(memory=MEMORY_MB * MB, cpu=0 if thing == "processors" else 0.8)
        interfaces = (
            InterfaceSpec(
                tag="flap", type="PublisherInterface", message_type="std_msgs/String", addr="/flap"
            ),
        )
        parts: ContainerParts = {"resources": limits, "interfaces": interfaces, "peer": "user/robot"}
        await machine.put(self._id, **parts)
        async with self._robot(interfaces):
            parts["nodes"] = (node,)
            await machine.put(self._id, 2, **parts)
            text = await self._outcome()
            if thing == "stop":
                await until(lambda: _is_stopped(self._world.environment(self._id).pid))
            answers = await ask(peer)
            if thing in STARTED_BESIDE:
                await self._start_another()
        found = {
            "has": max(map(int, re.findall(r"^has (\d+)$", text, re.MULTILINE)), default=0),
            "ended": self._end(text),
            "answers": answers,
            "tcp": (tcp_pages() - tcp) * mmap.PAGESIZE // MB,
            "disk": (_disk(self._world.folder) - disk) // MB,
            "reports": sum(
                getattr(getattr(one, "status", None), "id", "") == self._id for one in machine.told[told:]
            ),
            "faults": [one.text for one in machine.told[told:] if isinstance(one, Fault)],
        }
        begin = time.monotonic()
        await machine.drop(self._id)
        found["took to drop"] = round(time.monotonic() - begin, 1)
        return found

    @contextlib.asynccontextmanager
    async def _robot(self, interfaces: tuple[InterfaceSpec, ...]) -> AsyncIterator[None]:
        """A robot of the attacker's, wired to its container."""
        await until(lambda: (one := self._machine.status(self._id)) and one.state is EndpointState.RUNNING)
        status = self._machine.reported(self._id)
        robot = Peer(MACHINE)
        await robot.wire(status.address, interfaces, id_=self._id)
        try:
            yield
        finally:
            await robot.close()

    async def _start_another(self) -> None:
        """Make a container of somebody else meanwhile."""
        id_ = f"calm/beside_{self._thing}"
        await self._machine.put(id_, nodes=(NodeSpec(tag="talk", pkg="own", exe="talk.py"),))
        await self._machine.log_holds(id_, "talk", "hello")
        await self._machine.drop(id_)

    async def _outcome(self) -> str:
        """Wait for the last word of the node, or for its end, or for its container's."""
        seen = ""
        deadline = time.monotonic() + 60
        while True:
            assert time.monotonic() < deadline, (
                f"{self._thing}: no end ({seen[-300:]!r} {self._machine.faults})"
            )
            with contextlib.suppress(AssertionError):  # there is no log yet
                seen = await self._machine.log(self._id, "hog", -8192) or seen
            node = self._machine.node(self._id, "hog")
            is_over = node is not None and node.state is NodeState.FAILED
            if '{"ended"' in seen or is_over or self._failures() or self._writes_no_more():
                return seen
            await asyncio.sleep(0.05)

    def _writes_no_more(self) -> bool:
        """Whether the attack is that the environment, which writes the logs, stands still."""
        if self._thing != "stop":
            return False
        try:
            return _is_stopped(self._world.environment(self._id).pid)
        except (AssertionError, LookupError, OSError, ValueError):  # it is being made
            return False

    def _failures(self) -> int:
        return self._machine.manager._core.containers[self._id].failures

    def _end(self, text: str) -> str:
        for line in text.splitlines():
            _, begin, rest = line.partition('{"ended"')  # what processes write at once may share a line
            if begin:
                return str(json.JSONDecoder().raw_decode(begin + rest)[0]["ended"])
        return "the container died" if self._failures() else "killed"


async def ask(peer: Peer) -> int:
    """How many of three requests the neighbour's node answers."""
    request = bytes([5, 0, 0, 0]) + b"hello"
    answers = 0
    for _ in range(3):
        with contextlib.suppress(TimeoutError, LinkError):
            async with asyncio.timeout(60):
                answers += await peer.ends["srv"].port.call(request) == request
    return answers


def tcp_pages() -> int:
    """Pages of memory in all TCP sockets of the machine."""
    for line in Path("/proc/net/sockstat").read_text().splitlines():
        if line.startswith("TCP:"):
            return int(line.split()[-1])
    return 0


def _is_stopped(pid: int) -> bool:
    return "(stopped)" in Path(f"/proc/{pid}/status").read_text()


def _disk(folder: Path) -> int:
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                total += Path(parent, name).lstat().st_blocks * 512
    return total


def _no_filter() -> bytes:
    raise FilterUnavailableError("it is not wanted")


async def main() -> None:
    folder, runtime, what = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
    folder.mkdir()
    match what:
        case "attack":
            found = await attack(folder, runtime)
        case "unfiltered":
            with mock.patch("rce_container.runtimes.namespace.make_filter", _no_filter):
                found = await attack(folder, runtime, ("executed",))
        case _:
            found = await starve(folder, runtime, sys.argv[4:])
    print(json.dumps(found))  # noqa: T201 - for the test that started it


if __name__ == "__main__":
    asyncio.run(main())
