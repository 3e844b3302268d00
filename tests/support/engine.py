"""A real engine for end-to-end tests: master, robot and container task sets as separate processes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import signal
import sys
import urllib.request
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, TypedDict, TypeVar, Unpack, overload

import psutil

from support.ports import free_ports
from support.short_folders import make_folder
from tools.leaks import sweep_cgroups

T = TypeVar("T")

READY_TIMEOUT_S = 90.0
STOP_TIMEOUT_S = 90.0


@overload
async def until(
    condition: Callable[[], Awaitable[T | None]], *, timeout: float = ..., what: str = ...
) -> T: ...
@overload
async def until(condition: Callable[[], T | None], *, timeout: float = ..., what: str = ...) -> T: ...
async def until(
    condition: Callable[[], Awaitable[object] | object], *, timeout: float = 60.0, what: str = "condition"
) -> object:
    """Wait until ``condition`` gives something true, and return it."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout
    while True:
        asked = loop.time()
        made = condition()
        found = await made if isinstance(made, Awaitable) else made
        if found:
            return found
        if loop.time() > deadline:
            raise AssertionError(f"{what}: not within {timeout:.0f} s (last: {found!r})")
        # A condition that looks at all processes, or starts one, leaves time to what it waits for.
        await asyncio.sleep(min(max(0.05, loop.time() - asked), 1.0))


class Program:
    """A program of the engine as a process, its output kept in a file."""

    def __init__(self, name: str, argv: list[str], env: dict[str, str], folder: Path) -> None:
        self.name = name
        self.argv = argv
        self.env = env
        self.log = folder / f"{name}.log"
        self.process: asyncio.subprocess.Process | None = None

    @property
    def pid(self) -> int:
        assert self.process is not None
        return self.process.pid

    @property
    def running(self) -> bool:
        return self.process is not None and self.process.returncode is None

    def output(self) -> str:
        return self.log.read_text(errors="replace") if self.log.exists() else ""

    async def start(self, *, ready: str = " ready: ", timeout: float = READY_TIMEOUT_S) -> None:
        offset = self.log.stat().st_size if self.log.exists() else 0
        with self.log.open("ab") as log:
            self.process = await asyncio.create_subprocess_exec(
                *self.argv,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=self.env,
                start_new_session=True,
            )

        def is_ready() -> bool:
            assert self.running, (
                f"{self.name} ended with {self.process and self.process.returncode}:\n{self.output()}"
            )
            with self.log.open("rb") as log:
                log.seek(offset)
                return ready.encode() in log.read()

        await until(is_ready, timeout=timeout, what=f"{self.name} is ready\n{self.output()}")

    async def kill(self) -> None:
        """Kill -9."""
        assert self.process is not None
        self.process.kill()
        await self.process.wait()

    async def stop(self) -> int:
        """SIGTERM and wait."""
        assert self.process is not None
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGTERM)
        try:
            async with asyncio.timeout(STOP_TIMEOUT_S):
                return await self.process.wait()
        except TimeoutError:
            self.process.kill()
            await self.process.wait()
            raise AssertionError(f"{self.name} did not stop on SIGTERM:\n{self.output()}") from None


class EngineOptions(TypedDict, total=False):
    """Keywords of :class:`Engine`."""

    runtime: str
    robots: int
    apart: bool
    packages: Path | None
    machines: int
    robot_options: tuple[str, ...]
    images: bool


class Engine:
    """Master, robot and container task sets on ports of their own."""

    def __init__(
        self,
        folder: Path,
        *,
        runtime: str = "process",
        robots: int = 1,
        apart: bool = False,
        packages: Path | None = None,
        machines: int = 1,
        robot_options: tuple[str, ...] = (),
        images: bool = False,
    ) -> None:
        """Prepare an engine.

        Args:
            folder: For state and logs.
            runtime: Of the containers.
            robots: How many robot task sets.
            apart: Every task set takes itself to be on a machine of its own, so that links go over TCP.
            packages: A folder with more packages.
            machines: How many container task sets; several are on machines of their own, ``machine0``, ...
            robot_options: Options of the robot task sets.
            images: Whether containers may have an image, which a container task set tries at each start.
        """
        self.folder = folder
        self.http_port, self.control_port, *rest = free_ports(3 + 2 * robots + machines - 1)
        self.runtime = runtime
        self._images = images
        self._token = ""
        self.container_link_port = rest[0]
        self.robot_ports = [tuple(rest[1 + 2 * i : 3 + 2 * i]) for i in range(robots)]
        self.env = {
            **{key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))},
            "PYTHONUNBUFFERED": "1",
            "XDG_RUNTIME_DIR": str(folder),
            "RCE_SECRET": "a secret for the tests",
            **({"RCE_PACKAGE_PATH": str(packages)} if packages else {}),
        }
        self.master = self._program(
            "rce-master",
            *("--http-port", self.http_port, "--control-port", self.control_port),
            *("--state-dir", folder / "master", "--dev"),
        )
        self.robots = [
            self._program(
                "rce-robot",
                "127.0.0.1",
                *("--control-port", self.control_port, "--ws-port", ws, "--link-port", link, "--dev"),
                *(("--machine", f"robots{number}") if apart else ()),
                *robot_options,
                name=f"rce-robot-{number}",
            )
            for number, (ws, link) in enumerate(self.robot_ports)
        ]
        self.container = self._container(folder / "container", self.container_link_port, apart=apart)
        self.machines = [self.container]
        if machines > 1:
            ports = [self.container_link_port, *rest[1 + 2 * robots :]]
            self.machines = [
                self._container(folder / f"machine{number}", port, name=f"machine{number}")
                for number, port in enumerate(ports)
            ]
            self.container = self.machines[0]

    def _container(self, state: Path, link_port: int, *, name: str = "", apart: bool = False) -> Program:
        machine = name or ("containers" if apart else "")
        return self._program(
            "rce-container",
            "127.0.0.1",
            *("--control-port", self.control_port, "--link-port", link_port),
            *("--state-dir", state, "--runtime", self.runtime, "--dev"),
            *(() if self._images else ("--no-offer-images",)),
            *(("--machine", machine) if machine else ()),
            name=name,
        )

    def _program(self, program: str, *args: object, name: str = "") -> Program:
        argv = [str(Path(sys.executable).parent / program), *map(str, args)]
        return Program(name or program, argv, self.env, self.folder)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.http_port}/"

    @property
    def programs(self) -> list[Program]:
        return [self.master, *self.robots, *self.machines]

    async def start(self) -> None:
        for program in self.programs:
            await program.start()
        await until(self.accepts_robots, what="the master hands out a robot process")

    def accepts_robots(self) -> bool:
        try:
            self.get("/?userID=testUser&version=20130902", token="")
        except OSError:
            return False
        return True

    def has_no_robots(self) -> bool:
        """Whether no robot is connected; one that left may be so for a moment, and its name is taken then."""
        return all(robot["state"] != "connected" for robot in self.get("/api/v1/robots")["robots"])

    async def stop(self) -> None:
        if self._token and self.master.running:
            self._give_back()
        for program in reversed(self.programs):
            if program.running:
                await program.stop()

    def get(self, path: str, *, token: str | None = None) -> Any:
        """GET from the master's HTTP server; JSON comes back decoded."""
        headers = (
            {"Authorization": f"Bearer {self.token() if token is None else token}"} if token != "" else {}
        )
        with urllib.request.urlopen(
            urllib.request.Request(self.url.rstrip("/") + path, headers=headers), timeout=10
        ) as reply:
            text = reply.read().decode()
            return json.loads(text) if "json" in reply.headers.get("Content-Type", "") else text

    def _give_back(self) -> None:
        """Log out, as every program does that logged in."""
        headers = {"Authorization": f"Bearer {self._token}"}
        request = urllib.request.Request(f"{self.url}api/v1/login", headers=headers, method="DELETE")
        with contextlib.suppress(OSError), urllib.request.urlopen(request, timeout=10):
            self._token = ""

    def token(self) -> str:
        """Log in once; the token is good until the engine stops."""
        if not self._token:
            self._token = self._log_in()
        return self._token

    def _log_in(self) -> str:
        request = urllib.request.Request(
            f"{self.url}api/v1/login",
            data=json.dumps({"userID": "testUser", "password": "testUser"}).encode(),
            headers={"Content-Type": "application/json"},
        )
        with urllib.request.urlopen(request, timeout=10) as reply:
            return str(json.loads(reply.read())["token"])

    def processes_of(self, needle: str) -> list[psutil.Process]:
        """Processes of this engine whose command line or environment holds ``needle``."""
        found = []
        for process in engine_processes(self.folder):
            with contextlib.suppress(psutil.NoSuchProcess):
                if needle in " ".join(process.cmdline()):
                    found.append(process)
        return found

    def kill_processes(self, *needles: str) -> None:
        """Kill -9 each process that has one of these words in its command line.

        What ends with a process that was killed before it, as a sandbox's parts do, may be gone by then.
        """
        for needle in needles:
            for process in self.processes_of(needle):
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.kill()


def command_line(process: psutil.Process) -> list[str]:
    """The command line of a process; empty once it has ended."""
    try:
        return process.cmdline()
    except (psutil.NoSuchProcess, psutil.ZombieProcess):
        return []


def engine_processes(folder: Path) -> list[psutil.Process]:
    """All processes that an engine with this folder started, whatever their parent is, and their children."""
    children: dict[int, list[psutil.Process]] = {}
    found: dict[int, psutil.Process] = {}
    for process in psutil.process_iter():
        try:
            children.setdefault(process.ppid(), []).append(process)
            mine = str(folder) in " ".join(process.cmdline())
            if mine or process.environ().get("XDG_RUNTIME_DIR") == str(folder):
                found[process.pid] = process
        except (psutil.NoSuchProcess, psutil.AccessDenied, psutil.ZombieProcess):
            continue
    found |= {environment.pid: environment for environment in _environments(folder)}
    waiting = list(found)
    for pid in waiting:
        more = {child.pid: child for child in children.get(pid, ()) if child.pid not in found}
        found |= more
        waiting += more
    return list(found.values())


def _environments(folder: Path) -> list[psutil.Process]:
    """The environments that descend from nothing of the engine, because what forked them is gone."""
    found = []
    records = [Path(path, "record.json") for path, _, names in os.walk(folder) if "record.json" in names]
    for record in records:  # folders may vanish at any time
        with contextlib.suppress(OSError, ValueError, psutil.NoSuchProcess):
            pid = json.loads(record.read_bytes()).get("environment", 0)
            process = psutil.Process(pid) if pid else None
            if process is not None and "rce_container.environment" in process.cmdline():
                found.append(process)
    return found


@contextlib.contextmanager
def engine_folder() -> Iterator[Path]:
    """Give a folder with a short name, which nodes may enter; check that an engine in it leaves nothing."""
    folder = make_folder()
    folder.chmod(0o755)
    try:
        yield folder
    finally:
        left = engine_processes(folder)
        for process in left:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        cgroups = sweep_cgroups(folder)
        shutil.rmtree(folder)
    assert not left, f"processes left behind: {left}"
    assert not cgroups, f"cgroups left behind: {cgroups}"


@contextlib.asynccontextmanager
async def running_engine(**options: Unpack[EngineOptions]) -> AsyncIterator[Engine]:
    """Run an engine, and check at its end that it leaves nothing."""
    folder = make_folder()
    engine = Engine(folder, **options)
    try:
        await engine.start()
        yield engine
    except BaseException:
        for program in engine.programs:
            print(f"----- {program.name}\n{program.output()[-8000:]}")  # noqa: T201
        raise
    finally:
        await engine.stop()
        left = engine_processes(folder)
        for process in left:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        mounts = [line for line in Path("/proc/mounts").read_text().splitlines() if str(folder) in line]
        cgroups = sweep_cgroups(folder)
        shutil.rmtree(folder, ignore_errors=True)
    assert not left, f"processes left behind: {left}"
    assert not cgroups, f"cgroups left behind: {cgroups}"
    assert not mounts, f"mounts left behind: {mounts}"
