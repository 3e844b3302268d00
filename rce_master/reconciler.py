"""Sends the desired state to the task sets, and their reports to the state."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Protocol, assert_never

from rce.control import (
    PATCHES,
    SNAPSHOTS,
    VOLUMES,
    ClientRequest,
    Drop,
    Fault,
    Gone,
    Hello,
    Left,
    LogChunk,
    Login,
    LogQuery,
    Notify,
    PatchSpec,
    PatchStatus,
    PeerRefusedError,
    Probe,
    Put,
    RemoveVolume,
    SpecWanted,
    StateSaved,
    Status,
    StatusWanted,
    Sync,
    ToMaster,
    ToTaskSet,
    Usage,
    VolumeRemoved,
    VolumeRestored,
    VolumeSaved,
)
from rce_master.exceptions import MasterError, NotFoundError, RefusedError, TaskSetAwayError
from rce_master.logs import LogReader, LogRequest, read_log
from rce_master.reports import Report, ReportQueue
from rce_master.state import commands, task_sets, volume_moves
from rce_master.state.lifecycle import RobotSession
from rce_master.usage import UsageBook

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_master.state.changes import Changes, Notice, Touched
    from rce_master.state.volume_records import VolumeRemoval
    from rce_master.state_service import StateService

_log = logging.getLogger(__name__)

SILENT_S = 3.5
"""A robot task set that gave no sign of life for so long gets no robots if there is another one, and loses
those that come to another one. Each gives one every 2 s
(:class:`rce.control_channel.timeouts.ControlTimeouts`), and counts as gone after 10 s anyway."""


class Peer(LogReader, Protocol):
    """A connected task set; in a running master an :class:`rce.control_channel.peer.Peer`."""

    @property
    def process(self) -> str:
        """Its name."""

    @property
    def features(self) -> frozenset[str]:
        """Its features that earlier releases do not have."""

    @property
    def silence(self) -> float:
        """For how many seconds it gave no sign of life."""

    def send(self, message: ToTaskSet) -> None:
        """Send a message; the next ``Sync`` makes up for a lost one."""

    def abort(self) -> None:
        """Abort the connection; a task set that lives dials again."""

    async def save_state(self, id: str, node: str) -> str:  # noqa: A002 - wire name
        """Have the state of a node saved now; return why it is not saved."""


class Reconciler:
    """Sends every change to the task sets that it concerns.

    A change of an endpoint goes to its task set, as a patch of the revision that was last sent there; as a
    whole, without such a revision or if the task set does not take patches. Listens to the state service, so
    only stored changes are sent.

    Attributes:
        book: The usage reports of the connected task sets.
    """

    def __init__(self, state_service: StateService) -> None:
        self.book = UsageBook()
        self._state_service = state_service
        self._peers: dict[str, Peer] = {}
        self._arriving: dict[str, Peer] = {}
        self._sent: dict[str, dict[str, int]] = {}
        """The last revision of each endpoint that was sent to a connected task set, by process and id."""
        self._asked: set[tuple[str, str]] = set()
        """Endpoints whose whole status was requested, with their process."""
        self._reports = ReportQueue(state_service, self._ask_status)
        state_service.listeners.append(self.on_changes)

    async def run(self) -> None:
        """Repeat reports that the store did not take, until cancelled."""
        await self._reports.run()

    def silence(self, process: str) -> float:
        """Return for how many seconds a task set gave no sign of life; 0 if it is not connected."""
        peer = self._peers.get(process)
        return 0.0 if peer is None else peer.silence

    # From the task sets

    async def on_hello(self, peer: Peer, hello: Hello) -> None:
        """Handle a task set that just connected: adopt what runs there and send the desired state.

        Raises:
            PeerRefusedError: Its name cannot be used.
            StoreError: It cannot be stored; the task set is refused.
        """
        process = peer.process
        self._arriving[process] = peer
        self._reports.forget(process)
        try:
            outcomes = await self._state_service.submit_all(task_sets.arrival(hello))
            if (refusal := outcomes[0]) is not None:
                raise refusal
        except MasterError as error:
            if process not in self._peers and self._state_service.tables.is_connected(process):
                # Its last departure is not stored yet.
                self._reports.repeat_later(process, commands.TaskSetLeft(process=process))
            if isinstance(error, RefusedError):
                raise PeerRefusedError(str(error)) from error
            raise
        finally:
            self._arriving.pop(peer.process, None)

    async def on_message(self, process: str, message: ToMaster) -> None:
        """Queue a report. Reports are applied in the order of arrival, after this returns."""
        command: Report
        match message:
            case Status():
                self._asked.discard((process, message.status.id))
                command = commands.StatusReported(process=process, status=message.status)
            case PatchStatus():
                command = commands.StatusPatched(process=process, patch=message.patch)
            case SpecWanted():
                command = commands.SpecRequested(process=process, id=message.id)
            case Gone():
                command = commands.EndpointGone(process=process, id=message.id)
            case Fault():
                command = commands.FaultReported(id=message.id, text=message.text, robot=message.robot)
            case VolumeRemoved() | VolumeRestored():
                command = _command_of(process, message)
            case Left():
                command = commands.RobotLeft(process=process, id=message.id, reason=message.reason)
            case Usage():
                placed = {e.id for e in self._state_service.tables.endpoints.by("task_set", process)}
                self.book.note(process, message, placed)
                return
            case Hello() | Login() | ClientRequest() | LogChunk() | VolumeSaved() | StateSaved():
                _log.warning("%s sent a %s, which means nothing here", process, type(message).__name__)
                return
            case _:
                assert_never(message)
        await self._reports.submit(process, command)

    async def on_gone(self, peer: Peer) -> None:
        """Note that a task set's channel ended; what is not stored now is stored later."""
        if self._peers.get(peer.process) is peer:
            self._forget(peer.process)
            self.book.forget(peer.process)
            left = commands.TaskSetLeft(process=peer.process)
            await asyncio.wait([await self._reports.submit(peer.process, left)])

    async def read_log(
        self,
        id_: str,
        node: str,
        offset: int,
        limit: int,
        query: LogQuery = LogQuery(),  # noqa: B008 - it is frozen
    ) -> LogChunk:
        """Read the log of a container's node where it is (:func:`rce_master.logs.read_log`).

        Raises:
            NotFoundError: The container, node or log does not exist.
            TaskSetAwayError: Its task set is not connected or does not answer.
        """
        request = LogRequest(id_, node, offset, limit, query)
        return await read_log(self._state_service.tables, self._peers, request)

    def task_set_of(self, id_: str) -> Peer:
        """Return the connected task set of a container.

        Raises:
            NotFoundError: The container does not exist.
            TaskSetAwayError: Its task set is not connected, or it waits for a machine.
        """
        container = self._state_service.tables.container(id_)
        tag = id_.partition("/")[2]
        if container is None:
            raise NotFoundError(f"there is no container {tag!r}")
        peer = self._peers.get(container.task_set)
        if peer is None:
            raise TaskSetAwayError(f"container {tag!r} cannot be reached now")
        return peer

    @property
    def usage(self) -> Mapping[str, Usage]:
        """The last usage report of each connected task set, by process name."""
        return self.book.newest

    # To the task sets

    def on_changes(self, changes: Changes) -> None:
        """Send the messages that follow from a change."""
        for withdrawal in changes.withdrawals:
            message = Drop(
                id=withdrawal.id,
                revision=withdrawal.revision,
                reason=withdrawal.reason,
                elsewhere=withdrawal.elsewhere,
            )
            self._sent.get(withdrawal.process, {}).pop(withdrawal.id, None)
            self._send(withdrawal.process, message)
        for id_, touched in changes.touched.items():
            endpoint = self._state_service.tables.endpoints.get(id_)
            if endpoint is None:
                continue
            if id_ == changes.answered:
                # The answer's revision is not known yet, so the next change goes as a whole.
                self._sent.get(endpoint.task_set, {}).pop(id_, None)
            else:
                self._send_change(endpoint.task_set, id_, touched)
        for process, id_ in changes.wanted_specs:
            self._send_whole(process, id_)
        for process, id_ in changes.wanted_statuses:
            self._ask_status(process, id_)
        if changes.arrived:
            self._sync(changes.arrived)
        self._send_orders(changes)
        for notice in changes.notices:
            self._notify(notice)

    def probe(self, robot: str) -> None:
        """Ask the task set of a robot whether the robot still responds; give one up that is silent itself."""
        found = self._state_service.tables.robot(robot)
        if found is None:
            return
        self._send(found.task_set, Probe(id=robot))
        if self.silence(found.task_set) >= SILENT_S:
            _log.warning("task set %s is silent while %s comes to another one", found.task_set, robot)
            self._peers[found.task_set].abort()

    def _send_change(self, process: str, id_: str, touched: Touched) -> None:
        """Send the changes of an endpoint to its task set, and to the one it moves to."""
        if self._state_service.is_held(id_):
            self._sent.get(process, {}).pop(id_, None)
            return
        peer = self._peers.get(process)
        if peer is not None and self._sent[process].get(id_) == touched.since and PATCHES in peer.features:
            patch = self._state_service.patch(id_, touched)
            self._sent[process][id_] = patch.revision
            peer.send(PatchSpec(patch=patch))
        else:
            self._send_whole(process, id_)
        copy = self._state_service.copy_spec(id_)
        if copy is not None:
            self._send(copy[0], Put(endpoint=copy[1]))

    def _send_whole(self, process: str, id_: str) -> None:
        peer, endpoint = self._peers.get(process), self._state_service.tables.endpoints.get(id_)
        if peer is None or endpoint is None or endpoint.task_set != process:
            return  # a later command of the same batch may have removed it, or placed it elsewhere
        if not self._state_service.is_held(id_):
            spec = self._state_service.spec(id_)
            self._sent[process][id_] = spec.revision
            peer.send(Put(endpoint=spec))

    def _ask_status(self, process: str, id_: str) -> None:
        """Ask for the whole status of an endpoint, once until it arrives."""
        peer = self._peers.get(process)
        if peer is not None and (process, id_) not in self._asked:
            self._asked.add((process, id_))
            peer.send(StatusWanted(id=id_))

    def _sync(self, process: str) -> None:
        self._forget(process)
        peer = self._peers[process] = self._arriving[process]
        placed = self._state_service.tables.endpoints.by("task_set", process)
        is_held = self._state_service.is_held
        specs = tuple(self._state_service.spec(one.id) for one in placed if not is_held(one.id))
        self._sent[process] = {spec.id: spec.revision for spec in specs}
        peer.send(Sync(endpoints=specs))
        for removal in self._state_service.tables.volume_removals.by("process", process):
            self._remove_volume(removal)
        if SNAPSHOTS in peer.features:
            for order in self._state_service.state.orders(process):
                peer.send(order)

    def _send_orders(self, changes: Changes) -> None:
        """Tell task sets what they have to do with volumes."""
        for removal in changes.volume_removals:
            self._remove_volume(removal)
        for id_ in changes.volume_moves:
            self._order_for_move(id_)

    def _order_for_move(self, id_: str) -> None:
        """Tell task sets what a container's move with its volumes has come to."""
        tables = self._state_service.tables
        move = tables.volume_moves.get(id_)
        for process, message in [] if move is None else volume_moves.orders(tables, move):
            peer = self._peers.get(process)
            if peer is not None and SNAPSHOTS in peer.features:
                peer.send(message)

    def _remove_volume(self, removal: VolumeRemoval) -> None:
        peer = self._peers.get(removal.process)
        if peer is not None and VOLUMES in peer.features:
            peer.send(RemoveVolume(volume=removal.volume))

    def _forget(self, process: str) -> None:
        """Forget the revisions of a connection that ended."""
        self._peers.pop(process, None)
        self._sent.pop(process, None)
        self._asked = {asked for asked in self._asked if asked[0] != process}

    def _notify(self, notice: Notice) -> None:
        tables = self._state_service.tables
        user, slash, _ = notice.to.partition("/")
        robots = [tables.robot(notice.to)] if slash else tables.robots(user)
        connected = (
            robot.task_set
            for robot in robots
            if robot is not None and tables.robot_live(robot.id).session is RobotSession.CONNECTED
        )
        for process in dict.fromkeys(connected):
            self._send(process, Notify(id=notice.to, text=notice.text))

    def _send(self, process: str, message: ToTaskSet) -> None:
        peer = self._peers.get(process)
        if peer is not None:
            peer.send(message)


def _command_of(process: str, message: VolumeRemoved | VolumeRestored) -> Report:
    if isinstance(message, VolumeRemoved):
        return commands.VolumeRemoved(process=process, volume=message.volume)
    return commands.VolumeRestored(
        process=process, volume=message.volume, placement=message.placement, error=message.error
    )
