"""The base of the four roles of a robot's interfaces."""

from __future__ import annotations

import sys
from abc import abstractmethod
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from rce.aio.queues import OverflowPolicy
from rce.link import Interface, Port
from rce_robot.exceptions import MisdirectedError, RobotError, UnreadableError
from rce_robot.offload import Offload, Read, pack_value

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from rce.guard import Holding
    from rce.protocol import CallId, DataMessage, LargeData
    from rce_robot.conversion import Result
    from rce_robot.conversion.jobs import Job
    from rce_robot.doors.base import Queued
    from rce_robot.forms import Form
    from rce_robot.outgoing import Buffer, Outgoing, Rendered

URGENT_BELOW = 64 << 10
"""Service messages smaller than this (bytes) go in the control lane."""

MAX_WARNINGS = 256
"""Maximum number of different warnings of one interface."""
_ENTRY_SIZE = 512
"""Bytes that a remembered warning takes beside its text, about."""


class RobotSide(Protocol):
    """The interface of a role to its robot. These methods do not block or raise."""

    @property
    def connected(self) -> bool:
        """Whether the robot is connected."""

    def send_data(self, tag: str, message: Queued, overflow: OverflowPolicy, queue_size: int = 0) -> bool:
        """Send in the data lane; False if the queue refuses or the robot is away.

        Args:
            tag: Of the interface.
            message: The message.
            overflow: What its full queue does.
            queue_size: Messages of the interface that may wait; 0: as many as the limits allow.
        """

    def send_urgent(self, message: Queued) -> bool:
        """Send in the control lane; False if that is full or the robot is away."""

    def report(self, problem: str, call: CallId | None = None) -> None:
        """Send an ``ER``; with a call: that it failed."""

    def show_active(self, tag: str, active: bool) -> None:
        """Send an ``ST``."""

    @property
    def knows_sources(self) -> bool:
        """Whether the robot is connected and names the sources of latched messages."""

    def send_latched(self, tag: str, source: str, message: Queued, *, shared: bool) -> None:
        """Send a latched message in the data lane: it is not dropped, but replaced.

        Args:
            tag: Of the interface.
            source: The source of the message.
            message: Replaces an unsent one of the same source.
            shared: Whether its bytes are also kept elsewhere and counted there.
        """

    def send_sources(self, tag: str, sources: Sequence[str]) -> None:
        """Tell a robot that supports sources which ones' latched messages are in force."""

    def drop_latched(self, tag: str, source: str) -> None:
        """Undo :meth:`send_latched`, if the message was not sent yet."""

    def hold(self, size: int, give_up: Callable[[], object] | None = None) -> Holding:
        """Count bytes that are held outside all queues; see :class:`rce.guard.holdings.Holdings`."""

    async def convert(self, job: Job, parts: Sequence[Buffer]) -> tuple[Result, list[memoryview]]:
        """Have a conversion done in another process; raises :class:`ConversionFailedError`."""

    def await_binaries(self, large: LargeData, ids: Sequence[str]) -> LargeData | None:
        """Return a large message with the binary values that it refers to, if they have come.

        Otherwise return None, and handle it again when they have.
        """

    def run(self, work: Coroutine[Any, Any, None]) -> bool:
        """Run a coroutine until the robot leaves; return False (without effect) if too many run already."""

    def count_dropped(self, tag: str) -> None:
        """Count a message that was dropped before it was queued."""

    def closed(self, interface: RobotInterface) -> None:
        """Note that the interface was removed."""


class Delivery:
    """A message on its way to the robot, converted when its turn comes."""

    __slots__ = ("_interface", "_msg_id", "_payload", "size")

    def __init__(self, interface: RobotInterface, payload: Buffer, msg_id: str) -> None:
        self._interface = interface
        self._payload = payload
        self._msg_id = msg_id
        self.size = len(payload)

    def render(self) -> Rendered | None:
        """Convert the message; report a failure to the robot and to the caller that waits for an answer."""
        interface = self._interface
        try:
            return interface.pack(interface.form_out.show(self._payload), self._msg_id)
        except UnreadableError as error:
            interface.not_rendered(self._msg_id, str(error))
            return None


class RobotInterface(Interface):
    """Base of the four roles.

    Args:
        port: The way to the peers.
        robot: The way to the robot.
        form_in: Reads what the robot sends here.
        form_out: Writes what the robot gets here.
    """

    def __init__(self, port: Port, robot: RobotSide, form_in: Form, form_out: Form) -> None:
        super().__init__(port)
        self.robot = robot
        self.form_in = form_in
        self.form_out = form_out
        self.tag = port.spec.tag
        self.message_type = port.spec.message_type
        self.offload = Offload(robot, port.spec)
        self.active = False
        self._warned: dict[str, Holding | None] = {}

    @abstractmethod
    def take(self, message: DataMessage) -> None:
        """Handle a data message of the robot.

        Raises:
            RobotError: It is refused.
        """

    def take_large(self, large: LargeData) -> None:
        """Handle an unparsed data message, whose parsing takes long.

        Raises:
            RobotError: It is refused.
        """
        problem = "the interface takes nothing from the robot"
        raise MisdirectedError.at(self.tag, large.address.msg_id, problem)

    def keep_latched(self, sources: Sequence[str]) -> None:
        """Note that the robot's sources other than these ended."""

    def refused(self, msg_id: str, problem: str) -> None:
        """Note that a message of the robot with this id was refused; the robot has been told."""

    def on_active(self, active: bool) -> None:
        """Tell the robot whether the interface is in use."""
        self.active = active
        self.robot.show_active(self.tag, active)

    def robot_joined(self) -> None:
        """Send a newly connected robot the state of the interface."""
        if self.active:
            self.robot.show_active(self.tag, True)

    def robot_left(self) -> None:
        """Fail the calls that wait for the robot."""

    def not_rendered(self, msg_id: str, problem: str) -> None:
        """Handle a message to the robot that could not be converted."""
        self._report(problem, msg_id)

    def pack(self, msg: Any, msg_id: str) -> Rendered:
        """Return the data message that carries ``msg`` to the robot."""
        return self.form_out.pack(self.tag, self.message_type, msg_id, msg)

    async def start(self) -> None:
        """Do nothing: a robot's interface is usable as soon as it exists."""

    async def close(self) -> None:
        """Tell the robot's side that the interface was removed."""
        self.robot_left()
        for holding in self._warned.values():
            if holding is not None:
                holding.release()
        self._warned.clear()
        self.robot.closed(self)

    def _read(self, message: DataMessage, warn: Callable[[str], None]) -> Buffer:
        try:
            return self.form_in.read(message.msg, warn)
        except UnreadableError as error:
            raise UnreadableError.at(self.tag, message.msg_id, str(error)) from error

    def _pack(self, message: DataMessage) -> bytes:
        """Pack a message for its conversion in another process.

        Raises:
            UnreadableError: It fits no type.
        """
        try:
            return pack_value(message.msg)
        except UnreadableError as error:
            raise UnreadableError.at(self.tag, message.msg_id, str(error)) from error

    async def read_large(self, large: LargeData) -> Read:
        """Convert an unparsed message.

        If binary values of it have not come yet, it is handled again when they have; the result has their
        ids. If they have come, it is converted with them now, so that later messages do not overtake it.
        """
        read = await self.offload.read_text(large)
        complete = self.robot.await_binaries(large, read.ids) if read.ids else None
        if complete is None:
            return read
        holding = self.robot.hold(complete.size - large.size)
        try:
            return await self.offload.read_text(complete)
        finally:
            holding.release()

    def _warn(self, text: str) -> None:
        """Report an ignored field, once; again if the text was forgotten because memory is short."""
        if text in self._warned or len(self._warned) >= MAX_WARNINGS:
            return
        self._warned[text] = None
        holding = self.robot.hold(sys.getsizeof(text) + _ENTRY_SIZE, partial(self._warned.pop, text, None))
        if text in self._warned:  # else it was given up at once
            self._warned[text] = holding
        self.robot.report(f"{self.tag}: {text}")

    def _report(self, problem: str, msg_id: str) -> None:
        """Report a fault of one message to the robot, with or without a service call."""
        error = RobotError.at(self.tag, msg_id, problem)
        self.robot.report(error.problem, error.call)

    async def _show_large(self, payload: Buffer, msg_id: str) -> Outgoing:
        """Convert a large service message in another process.

        Raises:
            UnreadableError: It is not a message of the type.
        """
        return await self.offload.show(payload, msg_id)

    async def _send_service(self, payload: Buffer, msg_id: str) -> bool:
        """Send a request or an answer to the robot; return False if too many wait.

        Raises:
            UnreadableError: It is large and not a message of the type.
        """
        if self.form_out.is_heavy(payload):
            outgoing = await self._show_large(payload, msg_id)
            return self.robot.send_data(self.tag, outgoing, OverflowPolicy.REFUSE)
        delivery = Delivery(self, payload, msg_id)
        if len(payload) < URGENT_BELOW:
            return self.robot.send_urgent(delivery)
        return self.robot.send_data(self.tag, delivery, OverflowPolicy.REFUSE)
