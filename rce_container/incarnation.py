"""One incarnation of a container: its processes, control connection and folder, owned by one task."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import assert_never

import msgspec

from rce.aio.tasks import BackgroundTasks
from rce.control import (
    NODE_STATES,
    PATCHES,
    DesiredState,
    EndpointSpec,
    EndpointStatus,
    SpecPatch,
    StatusPatch,
    Unknown,
)
from rce.control.execution import FEATURE as EXEC
from rce.control.execution import Command
from rce.link import LinkAcceptor
from rce.model import EndpointId, Resources
from rce_container import events, intake
from rce_container.archive import LogArchive
from rce_container.environment import messages as m
from rce_container.environment import proc
from rce_container.environment.channel import Channel, connect
from rce_container.environment.exceptions import ChannelError
from rce_container.exceptions import (
    ExecutionError,
    KillError,
    LimitError,
    NetworkError,
    StartError,
    StateError,
)
from rce_container.folder import ContainerFolder
from rce_container.limits.enforcer import LimitEnforcer
from rce_container.links import ContainerLinks
from rce_container.logs import last_line
from rce_container.network import Networks
from rce_container.node_states import ContainerStates, StateCarrier
from rce_container.observed import OuterStatus
from rce_container.packages.disk import in_own_thread
from rce_container.packages.shelf import Shelf
from rce_container.packages.supply import Library, Supply
from rce_container.runtimes.base import Handle
from rce_container.settings import ContainerSettings
from rce_container.volumes.store import VolumeStore

_log = logging.getLogger(__name__)

_SHIM_TIMEOUT_S = 5.0
"""Seconds that the shim has to remove the folders of a container that ended properly."""
_GIVE_TIMEOUT_S = 3600.0
"""Seconds in which the files of volumes are given to a container's user, within its share of a processor."""
_LAST_OUTPUT_LENGTH = 300


@dataclass(frozen=True, slots=True, kw_only=True)
class IncarnationContext:
    """The context shared by all incarnations of all containers."""

    settings: ContainerSettings
    acceptor: LinkAcceptor
    feed: Callable[[events.Event], None]
    networks: Networks
    archive: LogArchive
    library: Library
    volumes: VolumeStore
    node_states: StateCarrier


class Incarnation:
    """One incarnation of one container, from the first process to the removal of the last file.

    Args:
        id: The container.
        folder: Belongs to this incarnation.
        handle: Its outermost process.
        enforcer: Enforces the limits of its control group.
        context: Shared by all incarnations.
        isolated: Whether pids that the environment reports are those of a namespace of its own.
    """

    def __init__(
        self,
        id: str,  # noqa: A002 - the model's word
        folder: ContainerFolder,
        handle: Handle,
        enforcer: LimitEnforcer,
        context: IncarnationContext,
        *,
        isolated: bool,
    ) -> None:
        self.id = id
        self.folder = folder
        self.handle = handle
        self.enforcer = enforcer
        self.counters = m.Counters()
        """The traffic of links and interfaces, as last reported by the environment."""
        self._observed = OuterStatus(self._outer_pids if isolated else None)
        self._filter = intake.PartFilter()
        self.reported = asyncio.Event()
        """Set by the first report, or by an end without a report."""
        self._context = context
        self._channel: Channel | None = None
        self._links = ContainerLinks(context.acceptor, context.settings)
        self._handles_links = False
        """Whether an environment runs for which links and limits are handled."""
        self._desired: DesiredState | None = None
        self._deadline: asyncio.Timeout | None = None
        self._features: frozenset[str] = frozenset()
        self._gives_files = False
        """Whether its environment is being made and is giving the files of volumes to its user."""
        self._stopping = False
        self._stop_reason = ""
        self._kill_now = False
        self._background = BackgroundTasks()
        self._dials = BackgroundTasks()
        self._node_states = ContainerStates(id, folder.incarnation_id, context.node_states)
        self._supply = Supply(
            self.incarnation_id,
            EndpointId.parse(id).user,
            context.library,
            Shelf(folder.user_packages, link=isolated),
            tell=lambda text: context.feed(events.Faulted(id, folder.incarnation_id, text)),
            on_arrival=self._tell_of_arrival,
        )

    @property
    def incarnation_id(self) -> str:
        """Names this incarnation."""
        return self.folder.incarnation_id

    @property
    def node_pids(self) -> dict[str, int]:
        """The pids of the nodes' first processes, as the machine sees them, by tag."""
        return self._observed.node_pids

    @property
    def status(self) -> EndpointStatus | None:
        """What the environment reported last; None if it has not."""
        return self._observed.whole

    @property
    def is_running(self) -> bool:
        """Whether its environment has reported, so that its volumes are mounted, and is not to end."""
        return self._channel is not None and self.reported.is_set() and not self._stopping

    def apply(self, spec: EndpointSpec) -> None:
        """Give the environment its desired state."""
        self._desired = DesiredState(spec)
        user = EndpointId.parse(self.id).user
        self._context.volumes.note(user, self.incarnation_id, spec.resources.volumes, spec.volumes)
        self._note_revision(spec.revision)
        self._supply.want(spec.packages)
        if self._channel is not None:
            self._channel.send(m.encode(m.Apply(spec=spec)))
        if self._handles_links:
            self._background.spawn(self._links.assign(spec), name=f"links of {self.id}")
            self._background.spawn(self._resize(spec.resources), name=f"limits of {self.id}")

    def apply_patch(self, patch: SpecPatch) -> None:
        """Give the environment a patch of its desired state, based on the revision that it has."""
        assert self._desired is not None, "a whole specification comes first"
        self._desired.patch(patch)
        if PATCHES not in self._features:
            self.apply(self._desired.whole)
            return
        self._note_revision(patch.revision)
        if patch.contents is not None:
            self._supply.want(patch.contents.packages)
            if self._handles_links:
                self._background.spawn(self._resize(patch.contents.resources), name=f"limits of {self.id}")
        if self._channel is not None:
            self._channel.send(m.encode(m.ApplyPatch(patch=patch)))
        if self._handles_links and (patch.links or patch.removed_links):
            self._background.spawn(self._links.change(patch), name=f"links of {self.id}")

    def _note_revision(self, revision: int) -> None:
        try:
            self.folder.note_revision(revision)
        except StateError as error:
            _log.warning("container %s: %s", self.id, error)

    def _tell_of_arrival(self) -> None:
        if self._channel is not None:
            self._channel.send(m.encode(m.Shelved()))

    def execute(self, command: Command, sock: socket.socket) -> None:
        """Have the environment run a command (:mod:`rce.control.execution`).

        Args:
            command: The command.
            sock: The environment's connection to the user; the caller closes its copy.

        Raises:
            ExecutionError: The environment cannot do it.
        """
        if self._channel is None or not self.is_running:
            raise ExecutionError("the container is not running")
        if EXEC not in self._features:
            raise ExecutionError(
                "the container was started by an earlier release; destroy it and create it again"
            )
        self._channel.send(m.encode(m.Execute(command=command)), sock.fileno())

    async def save_state(self, node: str) -> str:
        """Save the state of a node now.

        Returns:
            Why it is not saved; empty if the snapshot is acknowledged.
        """
        if self._channel is None or not self.is_running:
            return "its container is not running"
        if NODE_STATES not in self._features:
            return "its container was started by an earlier release, which saves no states"
        return await self._node_states.save(self._channel, node)

    async def save_states(self) -> None:
        """Save the states of all nodes that have services for it; the user is told of failures."""
        contents = self._desired.contents.nodes if self._desired is not None and self.is_running else ()
        nodes = [node.tag for node in contents if node.state_services is not None]
        for node, error in zip(nodes, await asyncio.gather(*map(self.save_state, nodes)), strict=True):
            if error:
                text = f"the state of node {node} is not saved at its end: {error}"
                _log.warning("container %s: %s", self.id, text)
                self._context.feed(events.Faulted(self.id, self.incarnation_id, text))

    def poll(self) -> None:
        """Ask for new :attr:`counters`, and report limits that were hit."""
        if self._channel is None or self._stopping:
            return
        self._channel.send(m.encode(m.Poll()))
        for text in self.enforcer.review():
            self._context.feed(events.Faulted(self.id, self.incarnation_id, text))

    def stop(self, reason: str = "", *, saves_states: bool = False) -> None:
        """Tell the environment to end; kill it if it does not.

        Args:
            reason: For the record of this incarnation.
            saves_states: Whether the states of its nodes are saved first.
        """
        if saves_states and self.is_running and not self._background.closed:
            self._background.spawn(self._save_and_stop(reason), name=f"last snapshots of {self.id}")
            return
        self._stopping = True
        self._stop_reason = reason or self._stop_reason
        if self._channel is not None:
            self._channel.send(m.encode(m.Stop()))
        if self._channel is not None or self._gives_files:
            self._limit(self._context.settings.stop_timeout)

    async def _save_and_stop(self, reason: str) -> None:
        await self.save_states()
        self.stop(reason)

    def stop_over_limit(self, text: str) -> None:
        """End, because a volume is too full; it is made again when the volume may hold more."""
        if not self._stopping:
            self._context.feed(events.Faulted(self.id, self.incarnation_id, text))
            self.stop(text)

    def kill(self) -> None:
        """End at once."""
        self._stopping = self._kill_now = True
        self._limit(0.0)

    async def run(self) -> None:
        """Run until the container has ended.

        A cancelled manager leaves the container running: it may be adopted.
        """
        try:
            reason = await self._live()
            if not self._stopping:
                reason = self.enforcer.claim_all() or reason
                reason += await asyncio.to_thread(self._last_output)
                _log.warning("container %s: %s", self.id, reason)
            self._context.feed(events.Lost(self.id, self.incarnation_id, reason))
            await asyncio.to_thread(self._note_end, reason)
            await self._clean(_SHIM_TIMEOUT_S if self._stopping and not self._kill_now else 0.0)
        except asyncio.CancelledError:
            self.handle.abandon()
            raise
        finally:
            self.reported.set()

    async def _live(self) -> str:
        """Exchange messages with the environment until it has ended; return the reason."""
        try:
            async with asyncio.timeout(self._context.settings.start_timeout) as self._deadline:
                await self._launch()
                if self._context.volumes.claims(self.incarnation_id):
                    await asyncio.to_thread(self._context.volumes.check_room, self.incarnation_id)
                self._channel = await connect(str(self.folder.control_socket))
                self._open_handover(self._channel)
                if self._stopping:
                    self.stop()
                if self._desired is not None:
                    self.apply(self._desired.whole)
                await self._converse(self._channel)
        except TimeoutError:
            self._kill_now = True
            return (
                "its environment did not end in time" if self._stopping else "its environment does not answer"
            )
        except (StartError, StateError, NetworkError) as error:
            return str(error)
        except (OSError, ChannelError, msgspec.DecodeError) as error:
            return f"its environment cannot be talked to: {error}"
        finally:
            await self._hang_up()
        return "its environment died"

    async def _launch(self) -> None:
        """Start the environment, and record it for a later manager.

        Raises:
            StartError: It cannot be started.
            StateError: The record cannot be written.
        """
        handle = self.handle
        before = handle.environment
        await handle.launch(self._prepare)
        if self._gives_files:
            self._gives_files = False
            self._limit(self._context.settings.start_timeout)
        record = self.folder.read_record()
        if handle.environment is before or handle.environment is None or record is None:
            return
        self.folder.write_record(
            msgspec.structs.replace(
                record,
                namespaces_pid=handle.namespaces_pid,
                environment=handle.environment.pid,
                environment_start=handle.environment.start,
            )
        )

    async def _prepare(self, pid: int) -> None:
        await self._context.networks.attach(self.incarnation_id, pid)
        if self._context.volumes.claims(self.incarnation_id):
            self._limit(None)  # an interrupted change of a file system's size destroys it
            await in_own_thread(self._context.volumes.prepare, self.incarnation_id)
            self._gives_files = True
            self._limit(self._context.settings.stop_timeout if self._stopping else _GIVE_TIMEOUT_S)

    async def _hang_up(self) -> None:
        self._deadline = None
        self._handles_links = False
        await self._background.close()
        await self._dials.close()
        await self._supply.close()
        await self._node_states.close()
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        self._links.close()

    async def _converse(self, channel: Channel) -> None:
        pace = intake.Pace()
        while (line := await channel.receive()) is not None:
            pace.pay(intake.PER_LINE + len(line))
            self._handle_message(channel, intake.read(line), pace)
            await asyncio.sleep(pace.pause)  # also for 0 s: others have their turns between two lines
            await channel.drain(intake.MAX_UNREAD)

    def _handle_message(self, channel: Channel, said: m.ToManager | Unknown, pace: intake.Pace) -> None:
        match said:
            case m.Report(status=status, features=features):
                self._features = frozenset(features) & {EXEC, PATCHES, NODE_STATES}
                status = intake.sanitize_status(self.id, status, self._newest_revision)
                self._report(self._filter.whole(status, self._desired), pace)
            case m.ReportPatch(patch=patch):
                patch = intake.sanitize_patch(self.id, patch, self._newest_revision)
                self._report_patch(self._filter.patch(patch, self._desired), pace)
            case m.SpecWanted():
                self._apply_again(pace)
            case m.Fault(text=text):
                pace.pay(intake.PER_FAULT)
                self._context.feed(events.Faulted(self.id, self.incarnation_id, intake.sanitize_text(text)))
            case m.Counters() as counters:
                self.counters = intake.sanitize_counters(counters)
            case m.Killed(request=number):
                channel.send(m.encode(m.Cause(request=number, text=self.enforcer.claim())))
            case m.StateWanted() | m.StateOffered() | m.StateSaved():
                self._node_states.handle(channel, said)
            case m.Dial() as request:
                self._begin_dial(channel, request)
            case Unknown(name=name):
                _log.debug("%s: its environment sent a %s", self.id, intake.sanitize_text(name))
            case message:
                assert_never(message)

    @property
    def _newest_revision(self) -> int:
        """The newest revision that the environment was given, by this manager or an earlier one."""
        if self._desired is not None:
            return self._desired.revision
        record = self.folder.read_record()
        return record.revision if record is not None else 0

    def _apply_again(self, pace: intake.Pace) -> None:
        """Give the environment its whole desired state; the cost counts for the environment."""
        pace.pay(intake.PER_FAULT)
        if self._desired is not None:
            pace.pay(intake.PER_PART * (len(self._desired.interfaces) + len(self._desired.connections)))
            self.apply(self._desired.whole)

    def _report(self, status: EndpointStatus, pace: intake.Pace) -> None:
        if not self._stopping:
            self._limit(None)
        status = self._observed.replace(status, pace)
        self.reported.set()
        self._context.feed(events.Reported(self.id, self.incarnation_id, status))

    def _report_patch(self, patch: StatusPatch, pace: intake.Pace) -> None:
        if (outer := self._observed.patch(patch, pace)) is not None:
            self._context.feed(events.Changed(self.id, self.incarnation_id, outer))

    def pids(self) -> Iterable[int]:
        """Return its processes, as the machine sees them."""
        return self._outer_pids()

    def _outer_pids(self) -> Iterable[int]:
        return self.enforcer.control_group.pids() or [one.pid for one in self.handle.members(proc.table())]

    def _limit(self, seconds: float | None) -> None:
        if self._deadline is not None and not self._deadline.expired():
            loop = asyncio.get_running_loop()
            self._deadline.reschedule(None if seconds is None else loop.time() + seconds)

    async def _resize(self, resources: Resources) -> None:
        if text := await self.enforcer.apply(resources):
            self._context.feed(events.Faulted(self.id, self.incarnation_id, text))

    # Links

    def _open_handover(self, channel: Channel) -> None:
        self._handles_links = True
        with self._links.open() as theirs:
            channel.send(m.encode(m.Handover(features=(PATCHES, NODE_STATES))), theirs.fileno())

    def _begin_dial(self, channel: Channel, request: m.Dial) -> None:
        if len(self._dials) < intake.MAX_DIALS:
            self._dials.spawn(self._dial(channel, request), name=f"dial for {self.id}")
        else:
            error = f"the container has {intake.MAX_DIALS} connections under way already"
            channel.send(m.encode(m.Dialed(request=request.request, error=error)))

    async def _dial(self, channel: Channel, request: m.Dial) -> None:
        links = self._desired.links.values() if self._desired is not None else ()
        try:
            sock = await self._links.dial(request.address, links)
        except OSError as error:
            text = str(error) or type(error).__name__
            channel.send(m.encode(m.Dialed(request=request.request, error=text)))
            return
        with sock:
            channel.send(m.encode(m.Dialed(request=request.request)), sock.fileno())

    # The end

    def _note_end(self, reason: str) -> None:
        if self._stopping:
            reason = "; ".join(filter(None, (self._stop_reason, reason if self._kill_now else "")))
        self._context.archive.end(self.id, self.incarnation_id, reason, time.time())

    def _last_output(self) -> str:
        words = last_line(self.folder.logs)[:_LAST_OUTPUT_LENGTH]
        return f"; its last output: {words}" if words else ""

    async def _clean(self, timeout: float) -> None:
        """Wait ``timeout`` seconds for the shim, then kill the remaining processes and remove the folder."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await self.handle.wait()
        try:
            await self.enforcer.end()
            await self.handle.kill()
        except KillError as error:
            _log.error("container %s: %s", self.id, error)
        await self._context.networks.detach(self.incarnation_id)
        await asyncio.to_thread(self.folder.remove)
        try:
            await self.enforcer.remove()
        except LimitError as error:
            _log.error("container %s: %s", self.id, error)
