"""Puts the container task set together and runs it until it is told to stop."""

from __future__ import annotations

import asyncio
import compileall
import contextlib
import logging
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rce.config import Secret, ShippedFileError, configs_dir, default_state_dir, examples_dir, run_dir
from rce.control import MachineInfo, VolumeLimit
from rce.control_channel.channel import TaskSetChannel
from rce.control_channel.connections import OpenConnections
from rce.control_channel.contents import ContentClient
from rce.control_channel.dialing import RunDialer
from rce.control_channel.node_states import NodeStateClient
from rce.control_channel.terms import Terms
from rce.control_channel.uploads import Uploader
from rce.link import LinkAcceptor, in_url, is_any, listen_on, own_address
from rce.masters import Masters, split_addresses, split_port
from rce.model import MEMORY_PER_SLOT
from rce.own_process import end_signals, listening, machine_memory
from rce.ros.packages import PackageIndex, installed_shares
from rce.tls import Context
from rce.tls.choice import TlsChoice
from rce_container.exceptions import RuntimeUnavailableError, StateError
from rce_container.folder import StateFolder
from rce_container.limits import Limiter, choose_limiter
from rce_container.manager import Manager
from rce_container.offers import Offers, find_offers
from rce_container.packages.cache import PackageCache
from rce_container.packages.requirements import Installer
from rce_container.packages.supply import Library
from rce_container.renewal import RENEW, inherited_children
from rce_container.runtimes.base import Runtime, source_root
from rce_container.runtimes.namespace import NamespaceRuntime
from rce_container.runtimes.podman import PodmanRuntime
from rce_container.runtimes.process import ProcessRuntime
from rce_container.settings import ContainerSettings
from rce_container.uids import UidPool
from rce_container.volumes.images import unavailable

_log = logging.getLogger(__name__)

AUTO = "auto"
RUNTIMES = (NamespaceRuntime.name, PodmanRuntime.name, ProcessRuntime.name)

_NOT_ISOLATED = "containers are NOT isolated: nodes have all permissions of this user"


@dataclass(frozen=True, slots=True, kw_only=True)
class App:
    """A container task set that is to be run."""

    master: str
    """Host of the master; several are separated by commas."""
    control_port: int
    secret: Secret
    settings: ContainerSettings
    runtime: str = AUTO
    link_port: int | None = None
    """None takes 10030 if it is free, else any."""
    host: str = ""
    """Address to accept links on; empty for all."""
    name: str = ""
    state_dir: Path | None = None
    tls: TlsChoice = field(default_factory=TlsChoice)

    async def run(self, ready: Callable[[str, str], None]) -> bool:
        """Run until SIGINT or SIGTERM; a second one ends the containers without waiting for their nodes.

        Args:
            ready: Called with the task set's name and its runtime when it listens.

        Returns:
            Whether the containers were released, so that the program can be started again
            (:mod:`rce_container.renewal`); else they ended.

        Raises:
            ContainerError: The state directory or the runtime cannot be used.
            OSError: The link port cannot be taken.
            CertificateError: The certificates cannot be used.
        """
        with inherited_children():
            quitting = Quitting()
            work = asyncio.create_task(self._run(quitting, ready), name="task set")
            quitting.on_renewal(work.cancel)
            try:
                await work
            except asyncio.CancelledError:
                if not quitting.renewal:
                    work.cancel()
                    raise
            return quitting.renewal

    def check(self) -> None:
        """Find out whether the program could start with these settings.

        Raises:
            ContainerError: The state directory cannot be used.
            CertificateError: The certificates cannot be used.
        """
        self.tls.for_task_sets()
        if not os.access(_existing(self._state_dir), os.R_OK | os.W_OK | os.X_OK):
            raise StateError(f"cannot use the state directory {self._state_dir}: it may not be written to")

    @property
    def _state_dir(self) -> Path:
        return self.state_dir or default_state_dir() / "container"

    async def _run(self, quitting: Quitting, ready: Callable[[str, str], None]) -> None:
        identity = self.tls.for_task_sets()
        if text := self.tls.plain_warning("", self.host):
            _log.warning("%s", text)
        tls = None if identity is None else identity.client
        uids = UidPool(self.settings.first_uid, self.settings.uids)
        home_bytes, packages = self.settings.home_bytes, self.settings.packages
        namespace = NamespaceRuntime(home_bytes=home_bytes, uids=uids, packages=packages)
        podman = PodmanRuntime(self.settings.images, home_bytes=home_bytes, uids=uids, packages=packages)
        runtimes: dict[str, Runtime] = {one.name: one for one in (namespace, podman, ProcessRuntime())}
        runtime, detail = await asyncio.to_thread(choose_runtime, self.runtime, runtimes)
        if review := runtime.review(self.settings.packages):
            _log.warning("%s", review)
        detail = "; ".join(filter(None, (detail, review)))
        limit, why = await asyncio.to_thread(find_volume_limit, runtime)
        if why:
            _log.info("volumes are folders that are watched: %s", why)
        others = runtimes.values() if self.settings.offer_images else ()
        offers = await asyncio.to_thread(find_offers, runtime, others)
        if not runtime.isolated:  # the probe of an isolated one has done it
            await asyncio.to_thread(_compile_engine)
        keep = self.settings.log_days, self.settings.log_space
        masters = self._masters(tls)
        with StateFolder(self._state_dir, run_dir(), log_days=keep[0], log_space=keep[1]) as state:
            name = state.name(self.name)
            acceptor = LinkAcceptor(tls=self.settings.tls)
            async with contextlib.AsyncExitStack() as stack:
                stack.push_async_callback(acceptor.close)
                with listening(self.host, self.link_port, "--link-port (rce up: --container-link-port)"):
                    port = await listen_on(acceptor.listen, self.host, self.link_port)
                limiter = await asyncio.to_thread(choose_limiter, state.token, state.cgroups)
                stack.callback(limiter.close)
                for one in runtimes.values():
                    stack.callback(one.close)
                beside = OpenConnections()
                client = ContentClient(masters, self.secret, tls=tls, connections=beside)
                library = await asyncio.to_thread(self._library, state, client)
                reach = self.host
                if is_any(reach):
                    first = split_port(split_addresses(self.master)[0], self.control_port)
                    reach = await own_address(*first, quitting.told)
                dialer = RunDialer(masters, self.secret, tls=tls, connections=beside)
                manager = Manager(
                    name=name,
                    info=_machine(self.settings, offers, limiter, detail, limit),
                    settings=self.settings,
                    runtimes=runtimes,
                    runtime=runtime,
                    state=state,
                    acceptor=acceptor,
                    links=(reach, port),
                    limiter=limiter,
                    library=library,
                    dialer=dialer,
                    uploader=Uploader(dialer),
                    fetch=client.piece,
                    node_states=NodeStateClient(dialer),
                )
                terms = Terms(state.term, state.keep_term)
                channel = TaskSetChannel(
                    masters,
                    self.secret,
                    manager.hello,
                    manager.handle,
                    tls=tls,
                    terms=terms,
                    connections=beside,
                )
                await _manage(manager, channel, quitting.of(manager), lambda: ready(name, runtime.name))

    def _masters(self, tls: Context | None) -> Masters:
        scheme = "ws" if tls is None else "wss"
        places = (split_port(address, self.control_port) for address in split_addresses(self.master))
        return Masters(f"{scheme}://{in_url(host)}:{port}" for host, port in places)

    def _library(self, state: StateFolder, client: ContentClient) -> Library:
        """Return the source of the packages that users bring. Blocks."""
        cache = PackageCache(state.library, client.piece, space=self.settings.bundle_space)
        requested = self.settings.requirements
        library = Library(
            cache=cache, installer=Installer(state.requirements, requested) if requested else None
        )
        library.open()
        return library


async def _manage(
    manager: Manager, channel: TaskSetChannel, quit_: asyncio.Event, ready: Callable[[], None]
) -> None:
    manager.send = channel.send
    async with asyncio.TaskGroup() as tasks:
        dialing: list[asyncio.Task[None]] = []

        def go() -> None:
            dialing.append(tasks.create_task(channel.run(), name="control channel"))
            ready()

        await manager.run(go, quit_)
        for task in dialing:
            task.cancel()


def choose_runtime(requested: str, runtimes: dict[str, Runtime]) -> tuple[Runtime, str]:
    """Find the runtime to use. Blocks.

    Args:
        requested: A runtime's name, or ``auto``: namespaces if they work here, else plain processes.
        runtimes: All runtimes.

    Returns:
        The runtime and what users should know of it; empty if all is well.

    Raises:
        RuntimeUnavailableError: The runtime that was asked for does not work here.
    """
    detail = ""
    if requested in (AUTO, NamespaceRuntime.name):
        namespace = runtimes[NamespaceRuntime.name]
        try:
            namespace.probe()
        except RuntimeUnavailableError as error:
            if requested != AUTO:
                raise
            detail = f"{error}; "
        else:
            return namespace, namespace.detail
    elif requested == PodmanRuntime.name:
        runtimes[requested].probe()
        return runtimes[requested], runtimes[requested].detail
    elif requested not in runtimes:
        raise RuntimeUnavailableError(
            requested, f"there is no such runtime; use one of {', '.join((AUTO, *runtimes))}"
        )
    detail += _NOT_ISOLATED
    _log.warning("%s", detail)
    return runtimes[ProcessRuntime.name], detail


def package_path(given: Sequence[Path]) -> tuple[Path, ...]:
    """All folders with packages: given, of the environment variables, shipped ones, the machine's ROS."""
    paths = [*given, *PackageIndex.from_environ().path]
    for shipped in (examples_dir, configs_dir):
        with contextlib.suppress(ShippedFileError):
            paths.append(shipped())
    paths += installed_shares()
    return tuple(dict.fromkeys(path.absolute() for path in paths))


class Quitting:
    """Handles signals from now on; a manager that starts after a signal ends adopted containers at once.

    Attributes:
        renewal: Whether the program is to release its containers and start again.
    """

    def __init__(self) -> None:
        self.told = asyncio.Event()
        """Set by the first signal to end."""
        self._manager: Manager | None = None
        self._let_go: Callable[[], object] = lambda: None
        self.renewal = False
        loop = asyncio.get_running_loop()
        for number in end_signals():
            loop.add_signal_handler(number, self._on_signal)
        loop.add_signal_handler(RENEW, self._on_renewal)

    def on_renewal(self, let_go: Callable[[], object]) -> None:
        """Register a callback for the request to start the program again."""
        self._let_go = let_go

    def of(self, manager: Manager) -> asyncio.Event:
        """Return the event that tells a manager to end; a second signal makes it kill its containers."""
        self._manager = manager
        return self.told

    def _on_signal(self) -> None:
        if self.told.is_set() and self._manager is not None:
            self._manager.kill_all()
        self.told.set()

    def _on_renewal(self) -> None:
        if self.told.is_set() or self.renewal:  # a shutdown that has begun continues
            return
        _log.info("restarting; containers stay")
        self.renewal = True
        self._let_go()


def find_volume_limit(runtime: Runtime) -> tuple[VolumeLimit, str]:
    """Find out how volumes are kept within their size, and why not better. Blocks."""
    why = unavailable() if runtime.isolated else f"the runtime {runtime.name} makes no mounts"
    return (VolumeLimit.WATCHED, why) if why else (VolumeLimit.IMAGE, "")


def _machine(
    settings: ContainerSettings, offers: Offers, limiter: Limiter, detail: str, volumes: VolumeLimit
) -> MachineInfo:
    memory = machine_memory()
    cores = os.cpu_count() or 0
    ceiling = limiter.ceiling()
    if ceiling.memory:
        memory = min(memory, ceiling.memory)
    if ceiling.cpu:
        cores = min(cores, math.ceil(ceiling.cpu))
    return MachineInfo(
        name=settings.machine,
        cores=cores,
        memory=memory,
        runtime=offers.runtimes[0],
        runtimes=offers.runtimes,
        networks=offers.networks,
        labels=settings.labels,
        requirements=settings.requirements is not None,
        volumes=volumes.value,
        slots=settings.slots or memory // MEMORY_PER_SLOT,
        limits=limiter.name,
        detail="; ".join(filter(None, (detail, limiter.detail, offers.detail))),
    )


def _existing(path: Path) -> Path:
    """Return the path, or of its parents the first that exists."""
    return next(one for one in (path, *path.absolute().parents) if one.exists())


def _compile_engine() -> None:
    """Compile the modules that containers import: containers, which see them read-only, cannot do it."""
    for package in ("rce", "rce_container"):
        compileall.compile_dir(source_root() / package, quiet=2)
