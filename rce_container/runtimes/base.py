"""The interface of runtimes: how a container's first process is started and all its processes are ended.

In every runtime a container depends on a *shim* (:mod:`rce_container.runtimes.shim`), which outlives the
manager.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterable, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import msgspec

from rce_container.environment import proc
from rce_container.environment.messages import Boot, encode
from rce_container.exceptions import KillError
from rce_container.folder import ContainerFolder, Record
from rce_container.runtimes.shim import spawn_shim
from rce_container.volumes.store import VolumeMount

_KILL_PAUSE_S = 0.01
_KILL_TIMEOUT_S = 10.0
_DISCARD_TIMEOUT_S = 1.0


class Order(NamedTuple):
    """An order to start a container."""

    tag: str
    boot: Boot
    """For the environment; :meth:`Runtime.start` adds the paths."""
    folder: ContainerFolder
    packages: tuple[Path, ...]
    control: int
    """Descriptor of the listening control socket."""
    links: int
    """Descriptor of the listening link socket."""
    join: tuple[str, ...] = ()
    """Files into which a process of the container writes its pid before it does anything else."""
    host_network: bool = False
    """Whether the container sees the machine's own network."""
    image: str = ""
    """See :attr:`rce.model.specs.Resources.image`."""
    switch: str = ""
    """A file of the network namespace of its group; it stays as long as the container."""
    volumes: tuple[VolumeMount, ...] = ()

    @property
    def volume_variables(self) -> dict[str, str]:
        """The environment variables with the paths of the volumes in the container."""
        return {volume.variable: volume.path for volume in self.volumes}


Prepare = Callable[[int], Awaitable[None]]
"""Prepares a container's namespaces, given the pid of a process in them, before other processes run there."""


class Handle:
    """A container's outermost process, started by this manager or by one before.

    Args:
        process: The shim.
        incarnation_id: The mark of the container's processes, if a kill has to search for it; else empty.
        popen: The shim as a child, if it is one.
    """

    def __init__(
        self, process: proc.Process, incarnation_id: str, popen: subprocess.Popen[bytes] | None = None
    ) -> None:
        self.process = process
        self.namespaces_pid = 0
        """A process that lives as long as the container's namespaces, and in them; 0 without namespaces."""
        self.environment: proc.Process | None = None
        """The environment, if it does not descend from :attr:`process`."""
        self._mark = incarnation_id
        self._popen = popen

    @property
    def alive(self) -> bool:
        """Whether the shim runs."""
        return proc.alive(self.process.pid, self.process.start)

    async def launch(self, prepare: Prepare | None = None) -> None:
        """Start the environment; return at once if it runs already.

        Args:
            prepare: Awaited when the namespaces exist and before the environment starts.

        Raises:
            StartError: It cannot be started.
        """

    def members(self, processes: dict[int, proc.Process]) -> list[proc.Process]:
        """Return all processes of the container, from a table of the machine's processes."""
        found: list[proc.Process] = []
        for root in (self.process, self.environment):
            if root is not None and proc.same(root, processes.get(root.pid)):
                found += proc.descendants(root.pid, processes)
        return found

    async def wait(self) -> None:
        """Wait until the shim has ended."""
        with contextlib.suppress(ProcessLookupError):
            fd = os.pidfd_open(self.process.pid)
            try:
                if self.alive:
                    await _readable(fd)
            finally:
                os.close(fd)
        self._collect()

    async def kill(self) -> None:
        """Kill all processes of the container, and wait until none is left.

        Raises:
            KillError: A process does not end, even after SIGKILL.
        """
        seen: dict[int, proc.Process] = {}
        loop = asyncio.get_running_loop()
        deadline = loop.time() + _KILL_TIMEOUT_S
        while True:
            if self._mark or seen or self._has_roots:  # else a search would find nothing
                seen.update((found.pid, found) for found in self.members(proc.table()))
            if self._mark:
                seen.update((found.pid, found) for found in proc.marked(self._mark))
            left = [one for one in seen.values() if proc.alive(one.pid, one.start)]
            if not left:
                break
            if loop.time() > deadline:
                raise KillError(f"processes that cannot be killed: {sorted(one.pid for one in left)}")
            for one in left:
                proc.kill(one)
            await asyncio.sleep(_KILL_PAUSE_S)
        self._collect()

    @property
    def _has_roots(self) -> bool:
        """Whether a process runs that may have descendants; cheap, unlike a scan of all processes."""
        environment = self.environment
        return self.alive or (environment is not None and proc.alive(environment.pid, environment.start))

    def _collect(self) -> None:
        """Collect the exit code, so that no zombie is left."""
        if self._popen is not None and not self.alive:
            self._popen.wait()
            self._popen = None

    def discard(self) -> None:
        """Kill the shim of a container that is not to start: all processes of the container end with it."""
        proc.kill(self.process)
        if self._popen is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):  # the next child's start collects it
                self._popen.wait(_DISCARD_TIMEOUT_S)
            self._popen = None

    def abandon(self) -> None:
        """Leave the container running: the manager ends and another may adopt it."""
        if self._popen is not None:
            self._popen.returncode = 0
            self._popen = None


class Runtime(ABC):
    """A way to make containers."""

    name: ClassVar[str]
    isolated: ClassVar[bool]
    """Whether the container has a pid namespace of its own, which ends with its environment."""
    image: str = ""
    """Root file system of containers that name none; empty for the machine's programs."""
    detail: str = ""
    """A text about restrictions, for the machine's record; known after :meth:`probe`."""

    @abstractmethod
    def probe(self) -> None:
        """Find out whether the runtime works on this machine. Blocks.

        Raises:
            RuntimeUnavailableError: It does not work; the text says why.
        """

    @abstractmethod
    def start(self, order: Order) -> Handle:
        """Start a container; :meth:`Handle.launch` completes it. Does not block.

        Raises:
            StartError: It cannot be started.
        """

    def is_starting(self, record: Record) -> bool:  # noqa: ARG002
        """Whether the manager that wrote this record ended before it had recorded the environment."""
        return False

    def review(self, packages: Iterable[Path]) -> str:  # noqa: ARG002
        """Return a text about folders of the package path that containers cannot see; empty if none."""
        return ""

    def close(self) -> None:  # noqa: B027 - most have no processes
        """End the runtime's own processes; containers keep running."""

    def user_packages(self, folder: ContainerFolder) -> str:
        """Return where the container sees the packages that its user brought; read-only if isolated."""
        return str(folder.user_packages)

    def adopt(self, process: proc.Process, record: Record) -> Handle:
        """Take over a container that an earlier manager started.

        Args:
            process: The running shim.
            record: The earlier manager's record.
        """
        handle = Handle(process, "" if self.isolated else record.incarnation_id)
        handle.namespaces_pid = record.namespaces_pid
        environment = proc.read(record.environment) if record.environment else None
        if environment is not None and environment.start == record.environment_start:
            handle.environment = environment
        return handle


class ExecRuntime(Runtime):
    """A runtime whose environments are programs that descend from the shim."""

    @abstractmethod
    def paths(self, folder: ContainerFolder) -> tuple[str, str]:
        """Return the container's home and log folder, as seen from inside."""

    @abstractmethod
    def command(self, order: Order, argv: Sequence[str]) -> tuple[list[str], dict[str, str]]:
        """Return the command line, and its variables, that runs ``argv`` as the container's environment."""

    def start(self, order: Order) -> Handle:
        """Start a container with its environment.

        Raises:
            StartError: It cannot be started.
        """
        home, logs = self.paths(order.folder)
        boot = encode_boot(order.boot, home, logs)
        argv, env = self.command(order, [sys.executable, "-P", "-m", "rce_container.environment", boot])
        incarnation_id = "" if self.isolated else order.folder.incarnation_id
        popen, process = spawn_shim(order, argv, env, (order.control, order.links), sweep=not self.isolated)
        return Handle(process, incarnation_id, popen)


def encode_boot(boot: Boot, home: str, logs: str) -> str:
    """Write the environment's configuration, with its paths."""
    return encode(msgspec.structs.replace(boot, home=home, logs=logs)).decode()


def clean_environ(home: str) -> dict[str, str]:
    """Return the environment variables of a container: none of the machine's are included."""
    environ = {
        "PATH": os.pathsep.join((str(Path(sys.executable).parent), "/usr/local/bin", "/usr/bin", "/bin")),
        "HOME": home,
        "LANG": "C.UTF-8",
        "ROS_IP": "127.0.0.1",
    }
    root = source_root()
    if not root.is_relative_to(Path(sys.prefix).resolve()):
        environ["PYTHONPATH"] = str(root)
    return environ


def source_root() -> Path:
    """Return the folder that contains the packages ``rce`` and ``rce_container``."""
    return Path(__file__).resolve().parents[2]


async def _readable(fd: int) -> None:
    loop = asyncio.get_running_loop()
    ready = loop.create_future()
    loop.add_reader(fd, _wake, ready)
    try:
        await ready
    finally:
        loop.remove_reader(fd)


def _wake(ready: asyncio.Future[None]) -> None:
    if not ready.done():
        ready.set_result(None)
