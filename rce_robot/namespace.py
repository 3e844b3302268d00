"""One robot, connected or not: its endpoint, its interfaces and its session.

The endpoint outlives connections: while a robot is away its interfaces and their connections stay, until
the master drops the robot or it comes back.
"""

from __future__ import annotations

import asyncio
import gc
from collections import Counter
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from rce.aio.queues import OverflowPolicy
from rce.control import (
    EndpointSpec,
    EndpointStatus,
    EndpointUsage,
    InterfaceUsage,
    LinkAddress,
    SpecPatch,
    StatusPatch,
)
from rce.guard import Holding, Holdings, Ledger
from rce.link import Endpoint, Interface, InterfaceError, LinkHub, Port
from rce.model import EndpointId, InterfaceSpec, InterfaceType, Request
from rce_robot.exceptions import MisdirectedError
from rce_robot.interfaces import make_interface
from rce_robot.reporting import RobotReporter

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from rce.protocol import CallId, DataMessage, ErrorReport, LargeData
    from rce_robot.conversion import ConversionPool, Result
    from rce_robot.conversion.jobs import Job
    from rce_robot.doors.base import DoorSession, Queued
    from rce_robot.forms import Form
    from rce_robot.interface import RobotInterface
    from rce_robot.outgoing import Buffer


_UNUSED = InterfaceUsage()
COLLECT_AFTER = 16 << 20
"""Dropped bytes after which a garbage collection makes sure that they are free."""


class Forms(Protocol):
    """Makes the forms of interfaces."""

    def pair(self, spec: InterfaceSpec, type_: InterfaceType) -> tuple[Form, Form]:
        """Return the forms from and to the robot; raise :class:`rce.link.InterfaceError` for a bad spec."""


class NamespaceListener(Protocol):
    """The interface of a namespace to the task set."""

    def changed(self, namespace: Namespace) -> None:
        """The robot's status changed."""

    def failed(self, namespace: Namespace, text: str) -> None:
        """Report a fault to the robot's user."""

    def robot_left(self, namespace: Namespace, reason: str) -> None:
        """The robot's connection ended."""

    async def ask_master(self, id: EndpointId, request: Request) -> tuple[ErrorReport, ...]:  # noqa: A002
        """Have the master carry out a robot's request; return the faults."""


class Namespace:
    """A robot.

    Implements :class:`rce_robot.interface.RobotSide`, :class:`rce_robot.doors.base.Owner` and
    :class:`rce.guard.budget.Holder`.

    Invariants: at most one session; ``_interfaces`` holds exactly what the endpoint has made and not closed.
    """

    def __init__(
        self,
        id: EndpointId,  # noqa: A002
        hub: LinkHub,
        forms: Forms,
        listener: NamespaceListener,
        address: LinkAddress,
        *,
        call_timeout: float,
        ledger: Ledger,
        pool: ConversionPool,
    ) -> None:
        self.id = id
        self.revision = 0
        self.session: DoorSession | None = None
        """The session from handshake to end, including times when it cannot send (yet, or any more)."""
        self.dropped: Counter[str] = Counter()
        self._live: DoorSession | None = None
        self._forms = forms
        self._listener = listener
        self._call_timeout = call_timeout
        self._interfaces: dict[str, RobotInterface] = {}
        self._applying = asyncio.Lock()
        self._pool = pool
        self._given_up = 0
        """Bytes dropped since the last garbage collection."""
        self._holdings = Holdings(self._note)
        self._account = ledger.open(id.user, self)
        self._endpoint = Endpoint(
            id, self._make, hub, on_change=self._changed, on_fault=self._failed, on_growth=self._account.note
        )
        self._reporter = RobotReporter(self._endpoint, address)

    async def apply(self, spec: EndpointSpec) -> None:
        """Make interfaces and connections as desired; an older revision than the applied one is ignored."""
        async with self._applying:
            if spec.revision >= self.revision:
                await self._endpoint.apply(spec)
                self.revision = spec.revision
        self._changed()

    async def patch(self, patch: SpecPatch) -> bool:
        """Apply a patch as :meth:`apply` a spec; return False if its base revision is not applied."""
        async with self._applying:
            if patch.revision > self.revision:
                if patch.base != self.revision:
                    return False
                await self._endpoint.patch(patch)
                self.revision = patch.revision
        self._changed()
        return True

    async def close(self, reason: str, *, elsewhere: bool = False, finishes: bool = False) -> None:
        """End the connection, if any, and remove all interfaces.

        Args:
            reason: For the robot.
            elsewhere: Whether the robot is to connect again, at another task set.
            finishes: Whether the requests that it has sent are carried out; else they are forgotten.
        """
        if self.session is not None:
            await self.session.close(reason, elsewhere=elsewhere, finishes=finishes)
        async with self._applying:
            await self._endpoint.close()
        self._account.close()

    def status(self) -> EndpointStatus:
        """Return the whole status for the master."""
        return self._reporter.whole(self.revision, self.session)

    def next_status(self, *, in_patches: bool) -> EndpointStatus | StatusPatch:
        """Return the next report for the master; a patch if ``in_patches``."""
        return self._reporter.next(self.revision, self.session, in_patches=in_patches)

    def usage(self) -> EndpointUsage:
        """Return the counters of the interfaces that were used.

        Messages dropped on the way to the robot are added.
        """
        return EndpointUsage(
            interfaces={
                tag: usage
                for tag, counted in self._endpoint.usage().items()
                if (usage := self._with_dropped(tag, counted)) != _UNUSED
            }
        )

    def _with_dropped(self, tag: str, usage: InterfaceUsage) -> InterfaceUsage:
        dropped = self.dropped[tag]
        return msgspec.structs.replace(usage, dropped=usage.dropped + dropped) if dropped else usage

    def tick(self) -> None:
        """Do periodic work; called every few seconds."""
        if self._live is not None:
            self._live.tick()

    # rce.guard.budget.Holder

    @property
    def held(self) -> int:
        """Bytes of all kept messages: on the way from and to the robot, latched, being served."""
        waiting = self._endpoint.waiting_bytes + self._holdings.bytes
        return waiting + (self.session.held if self.session is not None else 0)

    def shed(self, size: int) -> None:
        """Drop the oldest waiting messages, on the robot's side first."""
        before = self.held
        goal = before - size
        if self.session is not None:
            self.session.shed(size)
        if self.held > goal:
            self._endpoint.shed(self.held - goal)
        if self.held > goal:
            self._holdings.shed(self.held - goal)
        if self.held > goal:
            self._endpoint.drop_unfinished(self.held - goal)
        self._given_up += before - self.held
        if self._given_up > COLLECT_AFTER:
            # An error and its traceback are a cycle that may hold a message; the collector counts no bytes.
            self._given_up = 0
            gc.collect()

    def fail(self, reason: str) -> None:
        """Drop the robot's connection."""
        if self.session is not None:
            self.session.fail(reason)

    # rce_robot.doors.base.Owner

    def grew(self) -> None:
        """Count waiting messages."""
        self._account.note()

    def take(self, message: DataMessage) -> None:
        """Pass a data message of the robot to its interface.

        Raises:
            RobotError: It is refused.
        """
        interface = self._interfaces.get(message.i_tag)
        if interface is None:
            problem = f"robot {self.id.tag} has no such interface"
            raise MisdirectedError.at(message.i_tag, message.msg_id, problem)
        if message.message_type != interface.message_type:
            problem = f"carries {interface.message_type}, not {message.message_type}"
            error = MisdirectedError.at(message.i_tag, message.msg_id, problem)
            interface.refused(message.msg_id, str(error))
            raise error
        interface.take(message)

    def take_large(self, large: LargeData) -> None:
        """Pass an unparsed data message to its interface.

        Raises:
            RobotError: It is refused; the interface has been notified.
        """
        address = large.address
        interface = self._interfaces.get(address.i_tag)
        if interface is None:
            problem = f"robot {self.id.tag} has no such interface"
            raise MisdirectedError.at(address.i_tag, address.msg_id, problem)
        if address.message_type and address.message_type != interface.message_type:
            problem = f"carries {interface.message_type}, not {address.message_type}"
        elif not interface.form_in.readable:
            problem = "a Forwarder takes a serialized message as binary value 'msg*'"
        else:
            interface.take_large(large)
            return
        error = MisdirectedError.at(address.i_tag, address.msg_id, problem)
        interface.refused(address.msg_id, str(error))
        raise error

    def keep_latched(self, i_tag: str, sources: Sequence[str]) -> None:
        """End the latched messages of the robot's other sources at an interface."""
        interface = self._interfaces.get(i_tag)
        if interface is not None:
            interface.keep_latched(sources)

    def refused(self, call: CallId, problem: str) -> None:
        """End the service call of a message that was refused."""
        interface = self._interfaces.get(call.i_tag)
        if interface is not None:
            interface.refused(call.msg_id, problem)

    async def ask_master(self, request: Request) -> tuple[ErrorReport, ...]:
        """Have a request of the robot carried out; return the faults."""
        return await self._listener.ask_master(self.id, request)

    def joined(self, session: DoorSession) -> None:
        """Send the robot its initial messages."""
        self._live = session
        for interface in list(self._interfaces.values()):
            interface.robot_joined()

    def leaving(self, session: DoorSession) -> None:
        """Fail the calls that wait for the robot."""
        if self._live is session:
            self._live = None
        for interface in list(self._interfaces.values()):
            interface.robot_left()

    def left(self, session: DoorSession, reason: str) -> None:
        """Tell the master."""
        if self.session is session:
            self.session = None
            self._changed()
            self._listener.robot_left(self, reason)

    # rce_robot.interface.RobotSide

    @property
    def connected(self) -> bool:
        """Whether messages can be sent to the robot."""
        return self._live is not None

    def send_data(self, tag: str, message: Queued, overflow: OverflowPolicy, queue_size: int = 0) -> bool:
        """Send in the data lane."""
        return self._live is not None and self._live.send_data(tag, message, overflow, queue_size)

    def send_urgent(self, message: Queued) -> bool:
        """Send in the control lane."""
        return self._live is not None and self._live.send_urgent(message)

    def report(self, problem: str, call: CallId | None = None) -> None:
        """Send an ``ER``, if the robot is connected."""
        if self._live is not None:
            self._live.report(problem, call)

    def show_active(self, tag: str, active: bool) -> None:
        """Send an ``ST``, if the robot is connected."""
        if self._live is not None:
            self._live.show_active(tag, active)

    @property
    def knows_sources(self) -> bool:
        """Whether the robot is connected and names the sources of latched messages."""
        return self._live is not None and self._live.knows_sources

    def send_latched(self, tag: str, source: str, message: Queued, *, shared: bool) -> None:
        """Send the latched message of a source, if the robot is connected."""
        if self._live is not None:
            self._live.send_latched(tag, source, message, shared=shared)

    def send_sources(self, tag: str, sources: Sequence[str]) -> None:
        """Send an ``LT``, if the robot is connected and supports it."""
        if self._live is not None:
            self._live.send_sources(tag, sources)

    def drop_latched(self, tag: str, source: str) -> None:
        """Withdraw a latched message that was not sent yet."""
        if self._live is not None:
            self._live.drop_latched(tag, source)

    def hold(self, size: int, give_up: Callable[[], object] | None = None) -> Holding:
        """Count bytes that are held outside all queues."""
        return self._holdings.hold(size, give_up)

    async def convert(self, job: Job, parts: Sequence[Buffer]) -> tuple[Result, list[memoryview]]:
        """Have a conversion done in another process."""
        return await self._pool.convert(self.id.user, job, parts)

    def await_binaries(self, large: LargeData, ids: Sequence[str]) -> LargeData | None:
        """Return a large message with its binary values, if they have come; else handle it when they have."""
        return self._live.await_binaries(large, ids) if self._live is not None else None

    def run(self, work: Coroutine[Any, Any, None]) -> bool:
        """Run a coroutine until the robot leaves."""
        if self._live is None:
            work.close()
            return False
        return self._live.spawn(work)

    def count_dropped(self, tag: str) -> None:
        """Count a message that was dropped before it was queued."""
        self.dropped[tag] += 1

    def closed(self, interface: RobotInterface) -> None:
        """Forget an interface that the endpoint closed."""
        if self._interfaces.get(interface.tag) is interface:
            del self._interfaces[interface.tag]
            self.dropped.pop(interface.tag, None)
            if self._live is not None:
                self._live.discard(interface.tag)

    # Called by the endpoint

    def _make(self, port: Port) -> Interface:
        try:
            type_ = InterfaceType.parse(port.spec.type)
        except ValueError as error:
            raise InterfaceError(str(error)) from error
        form_in, form_out = self._forms.pair(port.spec, type_)
        interface = make_interface(type_.role, port, self, form_in, form_out, call_timeout=self._call_timeout)
        self._interfaces[interface.tag] = interface
        return interface

    def _note(self) -> None:
        self._account.note()

    def _changed(self) -> None:
        self._listener.changed(self)

    def _failed(self, text: str) -> None:
        self._listener.failed(self, text)
