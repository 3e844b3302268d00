"""The manager: carries out the decisions of :mod:`rce_container.core`, and feeds it events."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time
from collections.abc import Callable, Coroutine, Iterable, Mapping
from typing import TYPE_CHECKING, assert_never

from rce.control import (
    CONTROL_VERSION,
    NODE_STATES,
    PATCHES,
    SNAPSHOTS,
    VOLUMES,
    ClientReply,
    Drop,
    EndpointStatus,
    Execute,
    Hello,
    LinkAddress,
    LogChunk,
    LoginReply,
    MachineInfo,
    Notify,
    PatchSpec,
    PatchStatus,
    Probe,
    Put,
    ReadLog,
    Refused,
    RemoveVolume,
    RestoreVolume,
    SaveState,
    SaveVolume,
    StateSaved,
    Status,
    StatusWanted,
    Sync,
    TaskSetKind,
    ToMaster,
    ToTaskSet,
    Usage,
    VolumeLimit,
    Welcome,
)
from rce.control.execution import FEATURE as EXEC
from rce.control.execution import Command
from rce.model import EndpointId
from rce.own_process import cpu_seconds, resident_bytes
from rce_container import core, events
from rce_container.environment import proc
from rce_container.exceptions import ContainerError, ExecutionError, NetworkError, StateError
from rce_container.executions import Executions
from rce_container.folder import ContainerFolder, Record, StateFolder
from rce_container.former import FormerContainers
from rce_container.incarnation import Incarnation, IncarnationContext
from rce_container.launcher import Launcher
from rce_container.life import Phase
from rce_container.limits import ControlGroup, Limiter
from rce_container.limits.enforcer import LimitEnforcer
from rce_container.log_reads import LogReads
from rce_container.network import Networks
from rce_container.node_states import StateCarrier, save_all
from rce_container.packages.supply import Library
from rce_container.reading import read_for
from rce_container.runtimes.base import Handle, Runtime
from rce_container.start_queue import StartQueue
from rce_container.usage import Subject, UsageMeter
from rce_container.volumes.keeper import VolumeKeeper
from rce_container.volumes.snapshots import FetchPiece, SnapshotKeeper
from rce_container.volumes.store import VolumeStore

if TYPE_CHECKING:
    from rce.control_channel.dialing import RunDialer
    from rce.control_channel.node_states import NodeStateClient
    from rce.control_channel.uploads import Uploader
    from rce.link import LinkAcceptor
    from rce_container.settings import ContainerSettings

_log = logging.getLogger(__name__)


class Manager:
    """All containers of one machine, or of one task set on it.

    Args:
        name: The task set's name; stays the same after a restart.
        info: The machine.
        settings: How containers are run.
        runtimes: All runtimes by name, for containers that an earlier manager started.
        runtime: The one for new containers.
        state: The state directory.
        acceptor: Accepts links by TCP.
        links: Host and port of the acceptor.
        limiter: Enforces the containers' limits.
        library: Provides packages that users bring.
        dialer: Connects to the master for commands that users run; without it users cannot run commands.
        uploader: Sends snapshots of volumes to the master.
        fetch: Fetches contents from the master. Without these two, volumes stay on this machine.
        node_states: Has the master keep snapshots of nodes' states; without it they are not kept.

    Attributes:
        send: Sends a message to the master, or drops it while no master is connected.
    """

    def __init__(
        self,
        *,
        name: str,
        info: MachineInfo,
        settings: ContainerSettings,
        runtimes: Mapping[str, Runtime],
        runtime: Runtime,
        state: StateFolder,
        acceptor: LinkAcceptor,
        links: tuple[str, int],
        limiter: Limiter,
        library: Library,
        dialer: RunDialer | None = None,
        uploader: Uploader | None = None,
        fetch: FetchPiece | None = None,
        node_states: NodeStateClient | None = None,
    ) -> None:
        self._name = name
        self._info = info
        self._settings = settings
        self._state = state
        self._links = links
        self._limiter = limiter
        self.send: Callable[[ToMaster], None] = lambda _: None
        self._core = core.ManagerCore()
        self._master_features: frozenset[str] = frozenset()
        self._networks = Networks()
        images = info.volumes == VolumeLimit.IMAGE.value
        self._volumes = VolumeStore(state.volumes, images=images)
        self._keeper = VolumeKeeper(self._volumes, lambda m: self.send(m), self._spawn)  # noqa: PLW0108 - set later
        self._snapshots: SnapshotKeeper | None = None
        if uploader is not None and fetch is not None:
            self._snapshots = SnapshotKeeper(
                self._volumes,
                lambda m: self.send(m),  # noqa: PLW0108 - set later
                self._spawn,
                self._keeper.release,
                uploader=uploader,
                fetch=fetch,
            )
        self._launcher = Launcher(
            settings=settings,
            runtimes=runtimes,
            runtime=runtime,
            offered=info.runtimes,
            limiter=limiter,
            networks=self._networks,
            volumes=self._volumes,
        )
        self._former = FormerContainers(
            state, settings, limiter, self._launcher, self._volumes, self._keeper.release
        )
        self._node_states = StateCarrier(name, node_states)
        self._context = IncarnationContext(
            settings=settings,
            acceptor=acceptor,
            feed=self._feed,
            networks=self._networks,
            archive=state.archive,
            library=library,
            volumes=self._volumes,
            node_states=self._node_states,
        )
        self._executions = Executions(dialer, self._execute) if dialer is not None else None
        self._incarnations: dict[str, Incarnation] = {}
        """All incarnations that may have processes or folders, by id."""
        self._queue = StartQueue()
        self._starting: set[Incarnation] = set()
        self._tasks: asyncio.TaskGroup
        self._empty = asyncio.Event()
        self._meter = UsageMeter()
        self._log_reads = LogReads(self._read_log, lambda chunk: self.send(chunk))  # noqa: PLW0108 - set later

    # Messages of the master

    def hello(self) -> Hello:
        """Return the task set's name, machine and containers."""
        self._master_features = frozenset()
        self._node_states.learn(None)
        return Hello(
            version=CONTROL_VERSION,
            kind=TaskSetKind.CONTAINER,
            process=self._name,
            machine=self._info,
            endpoints=self._core.statuses,
            features=(
                PATCHES,
                NODE_STATES,
                VOLUMES,
                *([EXEC] if self._executions is not None else []),
                *([SNAPSHOTS] if self._snapshots is not None else []),
            ),
        )

    async def handle(self, message: ToTaskSet) -> None:
        """Handle a message of the master."""
        match message:
            case Welcome():
                self._learn(message)
            case Put() | PatchSpec() | StatusWanted() | Drop() | Sync():
                self._feed(events.event_of(message))
            case ReadLog():
                self._log_reads.take(message)
            case RemoveVolume(volume=volume):
                self._withdraw_orders([volume])  # a volume that is being restored is not wanted any more
                self._keeper.remove(volume)
            case SaveVolume() if self._snapshots is not None:
                self._snapshots.save(message)
            case RestoreVolume() if self._snapshots is not None:
                self._snapshots.restore(message)
            case SaveState() | Execute():
                self._begin(message)
            case (
                SaveVolume()
                | RestoreVolume()
                | Notify()
                | Probe()
                | Welcome()
                | Refused()
                | LoginReply()
                | ClientReply()
            ):
                _log.debug("not for a container task set: %s", type(message).__name__)
            case _:
                assert_never(message)

    def _learn(self, welcome: Welcome) -> None:
        """Take note of the master that leads, and of what it can do."""
        features = self._master_features = frozenset(welcome.features)
        if self._executions is not None:
            self._executions.welcomed(welcome.master, welcome.term)
        if self._snapshots is not None:
            self._snapshots.is_wanted = SNAPSHOTS in features
        self._node_states.learn(features)

    def _begin(self, order: SaveState | Execute) -> None:
        """Begin to do what takes a while."""
        if isinstance(order, SaveState):
            self._spawn(self._save_state(order), name=f"snapshot of {order.id}")
        elif self._executions is not None:
            self._spawn(self._executions.execute(order), name=f"command in {order.id}")

    def _execute(self, id_: str, command: Command, sock: socket.socket) -> None:
        incarnation = self._present(id_)
        if incarnation is None:
            raise ExecutionError("the container is not running here")
        incarnation.execute(command, sock)

    async def _save_state(self, message: SaveState) -> None:
        incarnation = self._present(message.id)
        error = "the container is not running here"
        if incarnation is not None:
            error = await incarnation.save_state(message.node)
        self.send(StateSaved(request=message.request, error=error))

    def _present(self, id_: str) -> Incarnation | None:
        """Return the incarnation of a container that is there now."""
        container = self._core.containers.get(id_)
        return self._incarnations.get(container.incarnation_id) if container is not None else None

    @property
    def statuses(self) -> tuple[EndpointStatus, ...]:
        """Return the present status."""
        return self._core.statuses

    # Life cycle

    async def run(self, ready: Callable[[], None], quit_: asyncio.Event) -> None:
        """Adopt the containers of an earlier manager, then manage until told to quit, and end all containers.

        A manager that is cancelled leaves its containers running.

        Args:
            ready: Called when all former containers are adopted or removed.
            quit_: Ends the manager.
        """
        with contextlib.closing(self._networks):
            async with asyncio.TaskGroup() as self._tasks:
                await asyncio.to_thread(self._volumes.places.clear_scratch)
                await self._former.take_over(self, self._tasks)
                ready()
                usage = self._tasks.create_task(self._report_usage(), name="usage")
                measuring = self._keeper.run(self._incarnations, self._settings.usage_interval)
                volumes = self._tasks.create_task(measuring, name="volumes")
                snapshots = self._tasks.create_task(self._take_snapshots(), name="snapshots")
                pruning = self._tasks.create_task(self._former.prune_logs(), name="old logs")
                await quit_.wait()
                if self._snapshots is not None:
                    await self._snapshots.close()  # this machine is not to be given a container any more
                await save_all(self._incarnations.values())
                self._feed(events.Quit())
                self._start_waiting()
                while self._incarnations:
                    self._empty.clear()
                    await self._empty.wait()
                usage.cancel()
                pruning.cancel()
                volumes.cancel()
                snapshots.cancel()
                await self._log_reads.close()

    def kill_all(self) -> None:
        """End all containers at once; for a quit that takes too long."""
        for incarnation in self._incarnations.values():
            incarnation.kill()

    async def adopt(self, folder: ContainerFolder, record: Record, process: proc.Process) -> None:
        """Adopt a container of an earlier manager, or kill it if it does not answer."""
        if record.group:
            try:
                self._networks.adopt(EndpointId.parse(record.id), record, folder.hosts)
            except NetworkError as error:
                _log.warning("container %s has lost its group: %s", record.id, error)
        runtime = self._launcher.runtime_of(record)
        handle = runtime.adopt(process, record)
        control_group = self._limiter.adopt(folder.incarnation_id)
        incarnation = self._own(record.id, folder, handle, control_group, isolated=runtime.isolated)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._settings.adopt_timeout):
                await incarnation.reported.wait()
        if (
            incarnation.status is None
            or incarnation.incarnation_id not in self._incarnations
            or record.id in self._core.containers
        ):
            _log.warning("container %s of an earlier manager does not answer; it is removed", record.id)
            incarnation.kill()
            return
        _log.info("adopted container %s", record.id)
        self._feed(events.Adopted(incarnation.incarnation_id, incarnation.status, self._address(folder)))

    # Instructions of the core

    def _feed(self, event: events.Event) -> None:
        for instruction in self._core.handle(event, asyncio.get_running_loop().time()):
            self._perform(instruction)

    def _perform(self, instruction: events.Instruction) -> None:
        match instruction:
            case events.Tell(message=message):
                self._tell(message)
            case events.Start(id=id_):
                self._queue.put(id_)
                self._start_waiting()
            case events.Apply(incarnation_id=incarnation_id, spec=spec):
                self._incarnations[incarnation_id].apply(spec)
            case events.ApplyPatch(incarnation_id=incarnation_id, patch=patch):
                self._incarnations[incarnation_id].apply_patch(patch)
            case events.Stop(incarnation_id=incarnation_id, reason=reason, saves_states=saves_states):
                self._incarnations[incarnation_id].stop(reason, saves_states=saves_states)
            case events.Wait(id=id_, ticket=ticket, delay=delay):
                asyncio.get_running_loop().call_later(delay, self._feed, events.Due(id_, ticket))
            case _:
                assert_never(instruction)

    def _tell(self, message: ToMaster) -> None:
        """Send a message to the master; one of an earlier release gets whole statuses."""
        if isinstance(message, PatchStatus) and PATCHES not in self._master_features:
            message = Status(status=self._core.containers[message.patch.status.id].status)
        self.send(message)

    def _start_waiting(self) -> None:
        """Start waiting containers within the limit, and drop those not desired any more."""
        for unwanted in self._queue.discard(self._is_unwanted):
            self._feed(events.Lost(unwanted, "", "it is not wanted any more"))
        most = self._settings.starts_at_once
        while len(self._starting) < most and (id_ := self._queue.take(one.id for one in self._starting)):
            self._start(id_)

    def _is_unwanted(self, id_: str) -> bool:
        container = self._core.containers.get(id_)
        return container is None or container.phase is not Phase.STARTING

    def _start(self, id_: str) -> None:
        user, resources = EndpointId.parse(id_).user, self._core.resources(id_)
        if orders := self._withdraw_orders([f"{user}/{volume.name}" for volume in resources.volumes]):
            self._spawn(self._start_after(orders, id_), name=f"wait for volumes of {id_}")
            return
        try:
            folder = self._state.create(id_)
        except StateError as error:
            self._feed(events.Lost(id_, "", str(error)))
            return
        try:
            handle, control_group, isolated = self._launcher.launch(
                id_, folder, resources, self._core.placements(id_)
            )
        except (ContainerError, OSError) as error:  # disk, descriptors or memory are exhausted
            self._spawn(self._undo(id_, folder.incarnation_id, str(error)), name=f"what was made of {id_}")
            folder.remove()
            self._state.archive.end(id_, folder.incarnation_id, f"cannot be started: {error}", time.time())
            return
        incarnation = self._own(id_, folder, handle, control_group, isolated=isolated)
        self._starting.add(incarnation)
        self._tasks.create_task(self._await_start(incarnation), name=f"start of {id_}")
        self._feed(events.Made(id_, folder.incarnation_id, self._address(folder)))

    def _spawn(self, work: Coroutine[None, None, None], name: str) -> asyncio.Task[None]:
        return self._tasks.create_task(work, name=name)

    async def _take_snapshots(self) -> None:
        if self._snapshots is not None:
            await self._snapshots.run(self._incarnations)

    def _withdraw_orders(self, volumes: Iterable[str]) -> list[asyncio.Task[None]]:
        return self._snapshots.withdraw(volumes) if self._snapshots is not None else []

    async def _start_after(self, orders: list[asyncio.Task[None]], id_: str) -> None:
        """Start a container whose volumes are still held by orders of a move that was given up."""
        await asyncio.wait(orders)
        self._queue.put(id_)
        self._start_waiting()

    async def _undo(self, id_: str, incarnation_id: str, error: str) -> None:
        """Remove what was made of a container that cannot be started; only then it is tried again."""
        await self._launcher.undo(incarnation_id)
        self._keeper.release(incarnation_id)
        self._feed(events.Lost(id_, "", error))

    async def _await_start(self, incarnation: Incarnation) -> None:
        with contextlib.suppress(TimeoutError):  # its volumes are being enlarged; others need not wait for it
            async with asyncio.timeout(self._settings.start_timeout):
                await incarnation.reported.wait()
        self._starting.discard(incarnation)
        self._start_waiting()

    def _own(
        self,
        id_: str,
        folder: ContainerFolder,
        handle: Handle,
        control_group: ControlGroup,
        *,
        isolated: bool,
    ) -> Incarnation:
        enforcer = LimitEnforcer(EndpointId.parse(id_).tag, control_group, self._settings)
        incarnation = Incarnation(id_, folder, handle, enforcer, self._context, isolated=isolated)
        self._incarnations[incarnation.incarnation_id] = incarnation
        self._tasks.create_task(self._run_incarnation(incarnation), name=f"container {id_}")
        return incarnation

    async def _run_incarnation(self, incarnation: Incarnation) -> None:
        await incarnation.run()
        del self._incarnations[incarnation.incarnation_id]
        self._keeper.release(incarnation.incarnation_id)
        self._feed(events.Removed(incarnation.id, incarnation.incarnation_id))
        if not self._incarnations:
            self._empty.set()

    def _address(self, folder: ContainerFolder) -> LinkAddress:
        host, port = self._links
        return LinkAddress(
            machine=self._settings.machine,
            unix=str(folder.link_socket),
            host=host,
            port=port,
            tls=self._settings.tls,
        )

    # Reading

    def _read_log(self, message: ReadLog) -> LogChunk:
        container = self._core.containers.get(message.id)
        incarnation_id = container.incarnation_id if container is not None else ""
        try:
            return read_for(self._state.archive, message, incarnation_id)
        except (OSError, ValueError) as error:
            return LogChunk(request=message.request, offset=message.offset, error=str(error))

    async def _report_usage(self) -> None:
        while True:
            await asyncio.sleep(self._settings.usage_interval)
            for incarnation in self._incarnations.values():
                incarnation.poll()
            wanted = {
                incarnation.id: Subject(
                    incarnation.handle,
                    incarnation.enforcer.control_group,
                    incarnation.node_pids,
                    incarnation.counters,
                )
                for incarnation in self._incarnations.values()
            }
            usage = await asyncio.to_thread(self._meter.measure, wanted)
            held = dict(self._volumes.used)
            self.send(Usage(cpu_s=cpu_seconds(), memory=resident_bytes(), endpoints=usage, volumes=held))
