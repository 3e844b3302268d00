"""The robot task set: robots' namespaces on one side, the master on the other.

It does not store data on disk: after a restart, the master's ``Sync`` and the returning robots restore its
state. While the master is away it continues to work, but new robots cannot log in.
"""

from __future__ import annotations

import asyncio
import gc
import logging
from typing import TYPE_CHECKING, assert_never

from rce.control import (
    CONTROL_VERSION,
    PATCHES,
    TYPED_REQUESTS,
    ClientReply,
    ControlError,
    Drop,
    EndpointSpec,
    Execute,
    Fault,
    Gone,
    Hello,
    Left,
    LinkAddress,
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
    SpecPatch,
    SpecWanted,
    Status,
    StatusPatch,
    StatusWanted,
    Sync,
    TaskSetKind,
    ToTaskSet,
    Usage,
    Welcome,
)
from rce.guard import Ledger, Lobby
from rce.model import EndpointId, Request
from rce.own_process import cpu_seconds, machine_memory, resident_bytes
from rce.protocol import Credentials, ErrorReport, HandshakeError
from rce.ros.tcpros.allocator import give_back_free_memory
from rce_robot.master_requests import MasterChannel, ask_master
from rce_robot.memory import UnusedMemory
from rce_robot.namespace import Forms, Namespace

if TYPE_CHECKING:
    from rce.link import LinkHub
    from rce_robot.conversion import ConversionPool
    from rce_robot.settings import RobotSettings

_log = logging.getLogger(__name__)

_OK, _UNAVAILABLE = 200, 503
_AGAIN_S = 1.0
"""After which a robot may try to log in again."""


class RobotTaskSet:
    """All robots of one process. Implements the interfaces of the gate and the namespaces.

    Invariant: every robot has at most one namespace; a new one is made only after the old one is closed.

    Args:
        hub: Links the robots' endpoints to others.
        forms: Makes converters and forwarders.
        settings: Its settings.
        name: The name of this process for the master.
        machine: Its machine.
        url: The URL for clients.
        address: Where links to any of the robots are accepted.
        lobby: Holds robots until they have logged in.
        pool: Converts large messages.
    """

    def __init__(
        self,
        hub: LinkHub,
        forms: Forms,
        settings: RobotSettings,
        *,
        name: str,
        machine: MachineInfo,
        url: str,
        address: LinkAddress,
        lobby: Lobby,
        pool: ConversionPool,
    ) -> None:
        self._hub = hub
        self._forms = forms
        self._settings = settings
        self._name = name
        self._machine = machine
        self._url = url
        self._address = address
        self._channel: MasterChannel
        self._namespaces: dict[EndpointId, Namespace] = {}
        self._closing: dict[EndpointId, asyncio.Event] = {}
        self._admitted: dict[EndpointId, int] = {}
        """Revisions of the robots' logins since the last ``Hello``: answers overtake messages that wait."""
        self._changed: set[Namespace] = set()
        self._lobby = lobby
        self._pool = pool
        self._ledger = Ledger(
            per_user=settings.user_memory,
            in_all=settings.memory or machine_memory() // 2,
        )
        self._tasks: asyncio.TaskGroup | None = None
        self._master_features: frozenset[str] = frozenset()
        self._unused = UnusedMemory(resident_bytes())

    # Messages of the master

    def use(self, channel: MasterChannel) -> None:
        """Set the channel, which was made with :meth:`hello` and :meth:`handle`."""
        self._channel = channel

    def hello(self) -> Hello:
        """Return the task set's name, machine and robots."""
        self._master_features = frozenset()
        self._admitted.clear()
        return Hello(
            version=CONTROL_VERSION,
            kind=TaskSetKind.ROBOT,
            process=self._name,
            machine=self._machine,
            url=self._url,
            address=self._address,
            endpoints=tuple(namespace.status() for namespace in self._namespaces.values()),
            bearer=True,
            features=(PATCHES,),
        )

    async def handle(self, message: ToTaskSet) -> None:
        """Handle a message of the master."""
        match message:
            case Welcome():
                self._master_features = frozenset(message.features)
            case Put():
                await self._apply(message.endpoint)
            case PatchSpec():
                await self._patch(message.patch)
            case StatusWanted():
                self._report_whole(EndpointId.parse(message.id))
            case Drop():
                self._take_drop(message)
            case Sync():
                await self._sync(message.endpoints)
            case Notify():
                self._notify(message)
            case Probe():
                self._probe(EndpointId.parse(message.id))
            case (
                Refused()
                | LoginReply()
                | ClientReply()
                | ReadLog()
                | RemoveVolume()
                | SaveVolume()
                | RestoreVolume()
                | SaveState()
                | Execute()
            ):
                _log.debug("not for a robot task set: %s", type(message).__name__)
            case _:
                assert_never(message)

    def _probe(self, id_: EndpointId) -> None:
        """End a robot's connection unless the robot answers: it logs in at another task set."""
        namespace = self._namespaces.get(id_)
        if namespace is not None and namespace.session is not None and self._tasks is not None:
            self._tasks.create_task(namespace.session.probe())

    async def run(self) -> None:
        """Report the usage, until cancelled; then close all namespaces."""
        try:
            async with asyncio.TaskGroup() as self._tasks:
                while True:
                    await asyncio.sleep(self._settings.usage_interval)
                    self._report_usage()
        finally:
            self._tasks = None
            async with asyncio.TaskGroup() as tasks:
                for namespace in self._namespaces.values():
                    tasks.create_task(_end(namespace, "the robot endpoint is shutting down", elsewhere=True))
            self._namespaces.clear()

    # Called by the gate: rce_robot.doors.base.Admission

    async def log_in(self, credentials: Credentials, address: str) -> EndpointSpec:
        """Ask the master whether a robot may log in.

        Raises:
            HandshakeError: It is refused, or the master is away.
        """
        try:
            async with asyncio.timeout(self._settings.login_timeout):
                who = credentials
                reply = await self._channel.login(who.user, who.robot, who.password, address, who.token)
        except (ControlError, TimeoutError) as error:
            reason = "The master cannot be reached, so logging in is not possible now. Try again."
            raise HandshakeError(_UNAVAILABLE, reason, _AGAIN_S) from error
        if reply.endpoint is None:
            status = reply.status if reply.status != _OK else _UNAVAILABLE
            raise HandshakeError(status, reply.reason or "Refused by the master.", reply.retry_after)
        return reply.endpoint

    def find(self, id: EndpointId) -> Namespace | None:  # noqa: A002
        """Return the robot's namespace if it exists."""
        return self._namespaces.get(id)

    async def settle(self, spec: EndpointSpec) -> Namespace:
        """Return the robot's namespace with the spec of its login applied; make it if it does not exist.

        Raises:
            HandshakeError: The master had the robot dropped meanwhile.
        """
        namespace = await self._apply(spec, logs_in=True)
        if not self._is_current(namespace):
            reason = "The robot was sent away while it logged in; connect again."
            raise HandshakeError(_UNAVAILABLE, reason, _AGAIN_S)
        return namespace

    async def _apply(self, spec: EndpointSpec, *, logs_in: bool = False) -> Namespace:
        id_ = EndpointId.parse(spec.id)
        while (closing := self._closing.get(id_)) is not None:
            await closing.wait()
        namespace = self._namespaces.get(id_)
        if namespace is None:
            namespace = self._namespaces[id_] = Namespace(
                id_,
                self._hub,
                self._forms,
                self,
                self._address,
                call_timeout=self._settings.call_timeout,
                ledger=self._ledger,
                pool=self._pool,
            )
        if logs_in and namespace.session is None:
            self._admitted[id_] = spec.revision
        await namespace.apply(spec)
        return namespace

    async def _patch(self, patch: SpecPatch) -> None:
        """Apply a patch of a robot's spec; ask for the whole spec if it does not fit."""
        namespace = self._namespaces.get(EndpointId.parse(patch.id))
        if namespace is None or not await namespace.patch(patch):
            self._channel.send(SpecWanted(id=patch.id))

    # Called by the namespaces: rce_robot.namespace.NamespaceListener

    def changed(self, namespace: Namespace) -> None:
        """Report a robot's status, once for all changes of one moment."""
        if not self._changed:
            asyncio.get_running_loop().call_soon(self._report_changes)
        self._changed.add(namespace)

    def failed(self, namespace: Namespace, text: str) -> None:
        """Report a fault."""
        self._channel.send(Fault(id=str(namespace.id), text=text, robot=str(namespace.id)))

    def robot_left(self, namespace: Namespace, reason: str) -> None:
        """Report that a robot's connection ended."""
        if self._is_current(namespace):
            self._channel.send(Left(id=str(namespace.id), reason=reason))

    async def ask_master(self, id: EndpointId, request: Request) -> tuple[ErrorReport, ...]:  # noqa: A002
        """Have a client's request carried out; return the faults."""
        return await ask_master(self._channel, id, request, typed=TYPED_REQUESTS in self._master_features)

    # Private

    def _is_current(self, namespace: Namespace) -> bool:
        return self._namespaces.get(namespace.id) is namespace

    def _report_changes(self) -> None:
        changed, self._changed = self._changed, set()
        for namespace in changed:
            if self._is_current(namespace):
                self._report(namespace, in_patches=PATCHES in self._master_features)

    def _report(self, namespace: Namespace, *, in_patches: bool) -> None:
        told = namespace.next_status(in_patches=in_patches)
        if isinstance(told, StatusPatch):
            self._channel.send(PatchStatus(patch=told))
        else:
            self._channel.send(Status(status=told))

    def _report_whole(self, id_: EndpointId) -> None:
        namespace = self._namespaces.get(id_)
        if namespace is not None:
            self._report(namespace, in_patches=False)

    def _report_usage(self) -> None:
        for namespace in self._namespaces.values():
            namespace.tick()
        self._ledger.refresh()
        self._give_back_memory()
        self._channel.send(
            Usage(
                cpu_s=cpu_seconds(),
                memory=resident_bytes(),
                endpoints={str(id_): namespace.usage() for id_, namespace in self._namespaces.items()},
                held=self._ledger.total,
                shed=self._ledger.shed,
                turned_away=self._lobby.turned_away + self._hub.lobby.turned_away,
            )
        )

    def _give_back_memory(self) -> None:
        """Return the memory of former messages to the kernel when it is worthwhile."""
        held = self._ledger.total
        if self._unused.is_due(resident_bytes(), held, self._ledger.growths):
            if self._unused.idle:
                gc.collect()  # cycles may hold messages; the collector does not count bytes
            give_back_free_memory()
            self._unused.given_back(resident_bytes(), held)

    async def _sync(self, specs: tuple[EndpointSpec, ...]) -> None:
        wanted = {spec.id for spec in specs}
        for id_ in list(self._namespaces):
            if str(id_) not in wanted and id_ not in self._admitted:
                self._drop(id_, "the master does not know this robot any more", 0)
        for spec in specs:
            await self._apply(spec)

    def _take_drop(self, drop: Drop) -> None:
        """Close a robot's namespace, unless the robot has logged in since the master sent the message."""
        id_ = EndpointId.parse(drop.id)
        if drop.revision >= self._admitted.get(id_, 0):
            self._drop(id_, drop.reason or "removed", drop.revision, elsewhere=drop.elsewhere)

    def _drop(self, id_: EndpointId, reason: str, revision: int, *, elsewhere: bool = False) -> None:
        """Start to close a robot's namespace; report its end to the master."""
        namespace = self._namespaces.get(id_)
        if namespace is not None and namespace.session is not None:
            # A login that was answered meanwhile and refused here made the master take it for connected.
            self.robot_left(namespace, reason)
        self._namespaces.pop(id_, None)
        self._admitted.pop(id_, None)
        if namespace is None or self._tasks is None:
            self._channel.send(Gone(id=str(id_), revision=revision))
            return
        self._closing[id_] = asyncio.Event()
        self._tasks.create_task(self._close(namespace, reason, revision, elsewhere=elsewhere))

    async def _close(self, namespace: Namespace, reason: str, revision: int, *, elsewhere: bool) -> None:
        try:
            # Its next task set knows of none of them, and its client repeats none that was received.
            await _end(namespace, reason, elsewhere=elsewhere, finishes=elsewhere)
        finally:
            self._closing.pop(namespace.id).set()
        self._channel.send(Gone(id=str(namespace.id), revision=revision))

    def _notify(self, message: Notify) -> None:
        for id_, namespace in self._namespaces.items():
            if message.id in (str(id_), id_.user):
                namespace.report(message.text)


async def _end(namespace: Namespace, reason: str, *, elsewhere: bool, finishes: bool = False) -> None:
    try:
        await namespace.close(reason, elsewhere=elsewhere, finishes=finishes)
    except Exception:  # noqa: BLE001 - logged; it must not end anything else
        _log.exception("closing robot %s", namespace.id)
