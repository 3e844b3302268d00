"""A machine with a manager of containers on it, and peers of the containers; for tests of one task set."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import TypedDict, TypeVar, Unpack

import msgspec
import pytest

from rce.config.folders import examples_dir
from rce.control.exceptions import ContentError
from rce.control.messages import (
    Drop,
    Fault,
    Gone,
    LogChunk,
    MachineInfo,
    Put,
    ReadLog,
    ToMaster,
    Usage,
    VolumeLimit,
)
from rce.control.model import (
    EndpointState,
    EndpointStatus,
    NodeState,
    NodeStatus,
)
from rce.control_channel.contents import Piece
from rce.control_channel.node_states import NodeStateClient
from rce.control_channel.uploads import Uploader
from rce.link.handover import LinkAcceptor
from rce_container.environment import proc
from rce_container.folder import Record, StateFolder
from rce_container.limits import choose_limiter
from rce_container.limits.files import children
from rce_container.manager import Manager
from rce_container.packages.cache import PackageCache
from rce_container.packages.supply import Library
from rce_container.runtimes.base import Runtime
from rce_container.runtimes.namespace import HOME_BYTES, NamespaceRuntime
from rce_container.runtimes.podman import PodmanRuntime
from rce_container.runtimes.process import ProcessRuntime
from rce_container.settings import ContainerSettings
from rce_container.volumes.snapshots import FetchPiece
from support.container_nodes import NODES
from support.container_specs import MACHINE, ContainerParts, container

RUNTIMES = ["process", pytest.param("namespace", marks=pytest.mark.needs("bwrap"))]


T = TypeVar("T")


async def until(
    condition: Callable[[], T | None],
    *,
    timeout: float = 60.0,
    what: str | Callable[[], object] = "condition",
) -> T:
    """Wait until ``condition`` gives something true, and return it."""
    deadline = time.monotonic() + timeout
    while not (found := condition()):
        assert time.monotonic() < deadline, f"{what() if callable(what) else what}: not within {timeout} s"
        await asyncio.sleep(0.01)
    return found


class ManagerOptions(TypedDict, total=False):
    """Fields of :class:`rce_container.settings.ContainerSettings` that tests give."""

    grace: float
    start_timeout: float
    interrupt_timeout: float
    terminate_timeout: float
    cleanup_timeout: float
    starts_at_once: int
    slot_memory: int
    slot_processes: int


class Machine:
    """A machine's disk, and the managers that run on it one after the other."""

    def __init__(
        self, folder: Path, runtime: str, images: Sequence[str] = (), home_bytes: int = HOME_BYTES
    ) -> None:
        self.folder = folder
        self.packages = folder / "packages"
        podman = PodmanRuntime(images, home_bytes=home_bytes, packages=(self.packages,))
        namespaces = NamespaceRuntime(home_bytes=home_bytes, packages=(self.packages,))
        runtimes: tuple[Runtime, ...] = (namespaces, podman, ProcessRuntime())
        self.runtimes = {one.name: one for one in runtimes}
        self.runtime = self.runtimes[runtime]
        self.runtime.probe()
        nodes = self.packages / "own" / "nodes"
        nodes.mkdir(parents=True)
        (self.packages / "own" / "package.yaml").write_text("name: own\n")
        for name, text in NODES.items():
            (nodes / name).write_text(text)
        self.library = Library(cache=PackageCache(folder / "bundles", self._fetch, space=1 << 30))
        self.library.open()
        self.contents: dict[str, bytes] = {}
        """What its master hands out, by hash."""
        self.node_states: NodeStateClient | None = None
        self.told: list[ToMaster] = []
        self._chunk: asyncio.Future[LogChunk] | None = None
        self.manager: Manager
        self.marks: set[str] = set()
        self.pids: dict[int, int] = {}
        self.volume_limit = VolumeLimit.WATCHED
        self.uploader: Uploader | None = None
        """Sends snapshots to its master; without it, volumes stay."""
        self.fetch_content: FetchPiece | None = None
        self.cgroups = folder / "none"
        """The file that says where the cgroups of this machine's containers are."""

    async def _fetch(self, sha256: str, offset: int) -> Piece:
        if sha256 not in self.contents:
            raise ContentError("the master does not have it", missing=True)
        found = self.contents[sha256]
        return Piece(found[offset : offset + 1000], len(found))

    @contextlib.asynccontextmanager
    async def managed(self, **options: Unpack[ManagerOptions]) -> AsyncIterator[Manager]:
        """Run a manager; it dies at the end of the block without a word to its containers."""
        options.setdefault("interrupt_timeout", 5.0)
        settings = ContainerSettings(
            machine=MACHINE, packages=(self.packages, examples_dir()), usage_interval=0.2, **options
        )
        acceptor = LinkAcceptor()
        port = await acceptor.listen("127.0.0.1", 0)
        with (
            StateFolder(self.folder / "state", self.folder / "run") as state,
            contextlib.closing(choose_limiter(state.token, state.cgroups)) as limiter,
        ):
            self.cgroups = state.cgroups
            self.manager = Manager(
                name=state.name(""),
                info=MachineInfo(
                    name=MACHINE, runtimes=tuple(self.runtimes), volumes=self.volume_limit.value
                ),
                settings=settings,
                runtimes=self.runtimes,
                runtime=self.runtime,
                state=state,
                acceptor=acceptor,
                links=("127.0.0.1", port),
                limiter=limiter,
                library=self.library,
                uploader=self.uploader,
                fetch=self.fetch_content,
                node_states=self.node_states,
            )
            self.manager.send = self._tell
            ready, self.quit = asyncio.Event(), asyncio.Event()
            task = asyncio.create_task(self.manager.run(ready.set, self.quit))
            waiting = asyncio.create_task(ready.wait())
            await asyncio.wait((waiting, task), return_when=asyncio.FIRST_COMPLETED)
            try:
                yield self.manager
                if self.quit.is_set():
                    await task
            finally:
                self.note_processes()
                task.cancel()
                waiting.cancel()
                await asyncio.gather(task, waiting, return_exceptions=True)
                await acceptor.close()

    @contextlib.asynccontextmanager
    async def engine(self, **options: Unpack[ManagerOptions]) -> AsyncIterator[Manager]:
        """Run a manager that ends properly, and check that nothing is left."""
        async with self.managed(**options) as manager:
            yield manager
            self.note_processes()
            self.quit.set()
        self.check_clean()

    def _tell(self, message: ToMaster) -> None:
        if isinstance(message, LogChunk) and self._chunk is not None and not self._chunk.done():
            self._chunk.set_result(message)
        else:
            self.told.append(message)

    # What it says

    def status(self, id_: str) -> EndpointStatus | None:
        return next((status for status in self.manager.statuses if status.id == id_), None)

    def reported(self, id_: str) -> EndpointStatus:
        """The newest status of a container that has one."""
        status = self.status(id_)
        assert status is not None, f"{id_} has no status"
        return status

    def node(self, id_: str, tag: str) -> NodeStatus | None:
        status = self.status(id_)
        return next((node for node in status.nodes if node.tag == tag), None) if status else None

    def reported_node(self, id_: str, tag: str) -> NodeStatus:
        """The newest status of a node that has one."""
        node = self.node(id_, tag)
        assert node is not None, f"{id_}/{tag} has no status"
        return node

    def of(self, kind: type[T]) -> list[T]:
        return [message for message in self.told if isinstance(message, kind)]

    @property
    def faults(self) -> list[str]:
        return [message.text for message in self.of(Fault)]

    @property
    def usage(self) -> list[Usage]:
        return self.of(Usage)

    # What it is told

    async def put(self, id_: str, revision: int = 1, **parts: Unpack[ContainerParts]) -> None:
        await self.manager.handle(Put(endpoint=container(id_, revision, **parts)))

    async def drop(self, id_: str, revision: int = 100, *, elsewhere: bool = False) -> None:
        self.note_processes()
        await self.manager.handle(Drop(id=id_, revision=revision, elsewhere=elsewhere))
        await until(lambda: any(m.id == id_ for m in self.of(Gone)), what=f"{id_} is gone")

    async def node_is(self, id_: str, tag: str, state: NodeState) -> NodeStatus:
        def found() -> NodeStatus | None:
            node = self.node(id_, tag)
            return node if node and node.state is state else None

        return await until(found, what=f"{id_}/{tag} is {state.value} (faults: {self.faults})")

    async def node_pid(self, id_: str, tag: str) -> int:
        """Wait until the pid of a node's process is reported. It may start yet: not all nodes register."""
        return await until(
            lambda: node.pid if (node := self.node(id_, tag)) else 0,
            what=lambda: f"the pid of {id_}/{tag} is told: {self.node(id_, tag)}, faults {self.faults}",
        )

    async def log(self, id_: str, node: str, offset: int = 0) -> str:
        request = ReadLog(request=1, id=id_, node=node, offset=offset, limit=1 << 20)
        return (await self.read_log(request)).text

    async def read_log(self, request: ReadLog) -> LogChunk:
        """Ask for a piece of a log and wait for the answer, which other messages may come before."""
        self._chunk = asyncio.get_running_loop().create_future()
        await self.manager.handle(request)
        async with asyncio.timeout(60):
            return await self._chunk

    async def log_holds(self, id_: str, node: str, text: str) -> str:
        deadline = time.monotonic() + 60
        while text not in (found := await self.log(id_, node)):
            assert time.monotonic() < deadline, f"{text!r} not in the log: {found!r}"
            await asyncio.sleep(0.02)
        return found

    # What is there

    def shims(self) -> list[proc.Process]:
        """The outermost processes of this machine's containers."""
        found = []
        for process in proc.table().values():
            with contextlib.suppress(OSError):
                words = Path(f"/proc/{process.pid}/cmdline").read_bytes().split(b"\0")
                if b"rce-container-shim" in words and any(
                    word.startswith(bytes(self.folder)) for word in words
                ):
                    found.append(process)
        pids = {process.pid for process in found}  # a child between fork and exec looks the same
        return [process for process in found if process.parent not in pids]

    def processes(self) -> list[proc.Process]:
        """All processes of this machine's containers that hang together with a shim or an environment."""
        processes = proc.table()
        roots = {shim.pid for shim in self.shims()} | {one.pid for one in self._environments()}
        return [one for root in roots for one in proc.descendants(root, processes)]

    def _environments(self) -> list[proc.Process]:
        """The environments that do not descend from a shim."""
        found = []
        for path in self.containers:
            with contextlib.suppress(OSError):
                record = msgspec.json.decode((path / "record.json").read_bytes(), type=Record)
                process = proc.read(record.environment) if record.environment else None
                if process is not None and process.start == record.environment_start:
                    found.append(process)
        return found

    def environment(self) -> proc.Process:
        """The environment of the only container."""
        for process in self.processes():
            words = Path(f"/proc/{process.pid}/cmdline").read_bytes().split(b"\0")
            if b"rce_container.environment" in words and b"python" in Path(words[0].decode()).name.encode():
                return process
        raise AssertionError("there is no environment")

    def note_processes(self) -> None:
        """Remember what runs now, to see later that it is gone."""
        self.pids.update((one.pid, one.start) for one in self.processes())
        self.marks |= {path.name for path in self.containers}

    def tidy(self) -> None:
        """Kill what a failed test left, and collect the exit codes that a dead manager did not."""
        for runtime in self.runtimes.values():
            runtime.close()
        for process in self.processes():
            proc.kill(process)
        for pid in self.pids:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, 0)
        if self.cell_parents():
            with StateFolder(self.folder / "state", self.folder / "run") as state:
                limiter = choose_limiter(state.token, state.cgroups)
                limiter.sweep(())
                limiter.close()

    @property
    def containers(self) -> list[Path]:
        with contextlib.suppress(FileNotFoundError):  # also while it is removed
            return list((self.folder / "state" / "containers").iterdir())
        return []

    def control_groups(self) -> list[Path]:
        """The cgroups of this machine's containers."""
        return [control_group for parent in self.cell_parents() for control_group in children(parent)]

    def cell_parents(self) -> list[Path]:
        lines = self.cgroups.read_text().splitlines() if self.cgroups.exists() else ()
        return [parent for parent in map(Path, lines) if parent.is_dir()]

    def left(self) -> list[str]:
        """All that containers left on the machine."""
        found = [f"process {pid}" for pid, start in self.pids.items() if proc.alive(pid, start)]
        found += [f"process {one.pid}" for one in self.processes()]
        found += [f"process {one.pid}" for mark in self.marks for one in proc.marked(mark)]
        found += map(str, self.containers)
        found += map(str, [*self.control_groups(), *self.cell_parents()])
        # Unlike rglob, os.walk passes over folders that are removed meanwhile.
        paths = [Path(at, name) for at, _, names in os.walk(self.folder / "run") for name in names]
        found += [str(path) for path in paths if path.is_socket()]
        found += [line for line in Path("/proc/mounts").read_text().splitlines() if str(self.folder) in line]
        return found

    def check_clean(self) -> None:
        assert self.left() == []


def is_in(machine: Machine, id_: str, state: EndpointState) -> bool:
    """Whether a container's newest status says this state."""
    return machine.reported(id_).state is state


def program_of(pid: int) -> str:
    """The name of the program that a process runs; empty if it is gone."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except (FileNotFoundError, ProcessLookupError):
        return ""
