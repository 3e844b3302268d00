"""The robot's end of connections: four roles, each with messages as JSON objects or serialized.

Roles are named from the engine's side (:class:`rce.protocol.names.Role`):

=================  ======================================  ==================================
role               from the robot                          to the robot
=================  ======================================  ==================================
Subscriber         messages, sent on to every peer         -
Publisher          -                                       messages of peers
ServiceProvider    requests, each with its own ``msgID``   answers with the request's ``msgID``
ServiceClient      answers                                 requests of peers
=================  ======================================  ==================================
"""

from __future__ import annotations

import asyncio
from abc import abstractmethod
from typing import TYPE_CHECKING, Any, Protocol

from rce.link import CallError, CallTimeout, Interface, Overloaded, PeerFault, PeerLost
from rce.protocol.messages import NO_ID
from rce.protocol.names import Role
from rce_robot.conveyor import Conveyor
from rce_robot.exceptions import BusyError, MisdirectedError, UnreadableError
from rce_robot.forms import fresh_id
from rce_robot.outbox import Overflow

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from rce.link import Port
    from rce.protocol.messages import DataMessage
    from rce_robot.forms import Form
    from rce_robot.outbox import Buffer, Outgoing, Queued

URGENT_BELOW = 64 << 10
"""Service messages smaller than so many bytes go in the control lane."""

MAX_WARNINGS = 256
"""Different warnings that one interface gives."""


class RobotSide(Protocol):
    """What an interface may do with its robot. Nothing here blocks or raises."""

    @property
    def connected(self) -> bool:
        """Whether the robot is there."""

    def send_data(self, tag: str, message: Queued, overflow: Overflow) -> bool:
        """Send in the data lane; False if the queue refuses or the robot is away."""

    def send_urgent(self, message: Queued) -> bool:
        """Send in the control lane; False if that is full or the robot is away."""

    def report(self, text: str) -> None:
        """Send an ``ER``."""

    def show_active(self, tag: str, active: bool) -> None:
        """Send an ``ST``."""

    def run(self, work: Coroutine[Any, Any, None]) -> bool:
        """Run something until the robot leaves; False (and nothing done) if too much runs already."""

    def count_dropped(self, tag: str) -> None:
        """A message was thrown away before it was queued."""

    def closed(self, interface: RobotInterface) -> None:
        """The interface is gone."""


class Delivery:
    """A message on its way to the robot, converted when its turn comes."""

    __slots__ = ("_interface", "_msg_id", "_payload", "size")

    def __init__(self, interface: RobotInterface, payload: Buffer, msg_id: str) -> None:
        self._interface = interface
        self._payload = payload
        self._msg_id = msg_id
        self.size = len(payload)

    def render(self) -> Outgoing | None:
        """Convert the message; a failure is reported to the robot and to whoever waits for an answer."""
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
        self.cls = port.spec.cls
        self.active = False
        self._warned: set[str] = set()

    @abstractmethod
    def take(self, message: DataMessage) -> None:
        """Handle a data message of the robot.

        Raises:
            RobotError: It is refused.
        """

    def on_active(self, active: bool) -> None:
        """Tell the robot."""
        self.active = active
        self.robot.show_active(self.tag, active)

    def robot_joined(self) -> None:
        """Give the robot that (again) connected what it must know."""
        if self.active:
            self.robot.show_active(self.tag, True)

    def robot_left(self) -> None:
        """Give up what waits for the robot."""

    def not_rendered(self, msg_id: str, problem: str) -> None:
        """Deal with a message to the robot that could not be converted."""
        self.robot.report(f"{self._name(msg_id)}: {problem}")

    def pack(self, msg: Any, msg_id: str) -> Outgoing:
        """Return the data message that carries ``msg`` to the robot."""
        return self.form_out.pack(self.tag, self.cls, msg_id, msg)

    async def start(self) -> None:
        """Do nothing: a robot's interface can be used as soon as it is there."""

    async def close(self) -> None:
        """Tell the robot's side that it is gone."""
        self.robot_left()
        self.robot.closed(self)

    def _read(self, message: DataMessage, warn: Callable[[str], None]) -> Buffer:
        try:
            return self.form_in.read(message.msg, warn)
        except UnreadableError as error:
            raise UnreadableError(f"{self._name(message.msg_id)}: {error}") from error

    def _warn(self, text: str) -> None:
        """Report something that was ignored, once."""
        if text not in self._warned and len(self._warned) < MAX_WARNINGS:
            self._warned.add(text)
            self.robot.report(f"{self.tag}: {text}")

    def _name(self, msg_id: str) -> str:
        return self.tag if msg_id == NO_ID else f"{self.tag}, msgID {msg_id}"

    def _send_service(self, payload: Buffer, msg_id: str) -> bool:
        delivery = Delivery(self, payload, msg_id)
        if len(payload) < URGENT_BELOW:
            return self.robot.send_urgent(delivery)
        return self.robot.send_data(self.tag, delivery, Overflow.REFUSE)


class FromRobot(RobotInterface):
    """Subscriber: what the robot says goes to every peer."""

    def __init__(self, port: Port, robot: RobotSide, form_in: Form, form_out: Form) -> None:
        super().__init__(port, robot, form_in, form_out)
        self._thread = Conveyor(robot.run, self._read_slowly, self._send) if form_in.costly else None

    def take(self, message: DataMessage) -> None:
        """Send it on."""
        if self._thread is None:
            self.port.send(self._read(message, self._warn))
        elif not self._thread.put(message):
            raise BusyError(f"{self.tag}: messages come faster than they can be converted; one was dropped")

    def robot_left(self) -> None:
        """Forget what waits to be converted."""
        if self._thread is not None:
            self._thread.clear()

    def _read_slowly(self, message: DataMessage) -> tuple[Buffer | None, list[str]]:
        """Convert, in a thread; return what to send and what to report."""
        problems: list[str] = []
        try:
            return self._read(message, problems.append), problems
        except UnreadableError as error:
            return None, [str(error)]

    def _send(self, converted: tuple[Buffer | None, list[str]]) -> None:
        payload, problems = converted
        for problem in problems:
            if payload is None:
                self.robot.report(problem)
            else:
                self._warn(problem)
        if payload is not None:
            self.port.send(payload)


class ToRobot(RobotInterface):
    """Publisher: what the peers say goes to the robot.

    The last latched message is kept and given again to a robot that comes back, as a latched topic does to
    every new subscriber. Other messages that come while the robot is away are dropped.
    """

    def __init__(self, port: Port, robot: RobotSide, form_in: Form, form_out: Form) -> None:
        super().__init__(port, robot, form_in, form_out)
        self._latched: bytes | None = None
        self._thread = Conveyor(robot.run, self._show_slowly, self._send_shown) if form_out.costly else None

    def take(self, message: DataMessage) -> None:
        """Refuse it."""
        raise MisdirectedError(f"{self._name(message.msg_id)}: the interface takes nothing from the robot")

    def receive(self, payload: bytes, *, latched: bool) -> None:
        """Send a peer's message to the robot."""
        if latched:
            self._latched = payload
        self._send(payload)

    def robot_joined(self) -> None:
        """Also give it the last latched message."""
        super().robot_joined()
        if self._latched is not None:
            self._send(self._latched)

    def robot_left(self) -> None:
        """Forget what waits to be converted."""
        if self._thread is not None:
            self._thread.clear()

    def _send(self, payload: bytes) -> None:
        if self._thread is None:
            self.robot.send_data(self.tag, Delivery(self, payload, NO_ID), Overflow.DROP_OLDEST)
        elif self.robot.connected and not self._thread.put(payload):
            self.robot.count_dropped(self.tag)

    def _show_slowly(self, payload: bytes) -> tuple[Any, str]:
        """Convert, in a thread; return what to send or what is wrong."""
        try:
            return self.form_out.show(payload), ""
        except UnreadableError as error:
            return None, str(error)

    def _send_shown(self, converted: tuple[Any, str]) -> None:
        msg, problem = converted
        if problem:
            self.not_rendered(NO_ID, problem)
        else:
            self.robot.send_data(self.tag, self.pack(msg, NO_ID), Overflow.DROP_OLDEST)


class AskedByRobot(RobotInterface):
    """ServiceProvider: the robot calls the peer's service. Calls run side by side."""

    def take(self, message: DataMessage) -> None:
        """Start a call."""
        payload = self._read(message, self._warn)
        if not self.robot.run(self._call(payload, message.msg_id)):
            raise BusyError(f"{self._name(message.msg_id)}: too many calls wait for an answer")

    async def _call(self, payload: Buffer, msg_id: str) -> None:
        try:
            answer = await self.port.call(payload)
        except CallError as error:
            self.robot.report(f"{self._name(msg_id)}: {error}")
            return
        if not self._send_service(answer, msg_id):
            self.robot.report(f"{self._name(msg_id)}: the answer was dropped, too much waits to be sent")


class AnsweredByRobot(RobotInterface):
    """ServiceClient: peers call the robot's service. Calls run side by side."""

    def __init__(
        self, port: Port, robot: RobotSide, form_in: Form, form_out: Form, *, call_timeout: float
    ) -> None:
        super().__init__(port, robot, form_in, form_out)
        self._timeout = call_timeout
        self._calls: dict[str, asyncio.Future[Buffer]] = {}

    async def serve(self, payload: bytes) -> Buffer:
        """Ask the robot.

        Raises:
            CallError: It is away, leaves, is busy, answers with a fault or not in time.
        """
        if not self.robot.connected:
            raise PeerLost("the robot is not connected")
        msg_id = fresh_id()
        answer: asyncio.Future[Buffer] = asyncio.get_running_loop().create_future()
        self._calls[msg_id] = answer
        try:
            if not self._send_service(payload, msg_id):
                raise Overloaded("too much waits to be sent to the robot")
            async with asyncio.timeout(self._timeout):
                return await answer
        except TimeoutError as error:
            raise CallTimeout(f"the robot did not answer within {self._timeout:g} s") from error
        finally:
            del self._calls[msg_id]

    def take(self, message: DataMessage) -> None:
        """Complete a call. A string in place of ``msg`` is the robot's word for why it failed."""
        answer = self._calls.get(message.msg_id)
        if answer is None or answer.done():
            raise MisdirectedError(f"{self._name(message.msg_id)}: no call waits for this answer")
        if isinstance(message.msg, str):
            answer.set_exception(PeerFault(message.msg))
            return
        try:
            answer.set_result(self._read(message, self._warn))
        except UnreadableError as error:
            answer.set_exception(PeerFault(f"the robot's answer cannot be read: {error}"))
            raise

    def robot_left(self) -> None:
        """Fail the calls that wait."""
        self._fail_all(PeerLost("the robot's connection ended before it answered"))

    def not_rendered(self, msg_id: str, problem: str) -> None:
        """Fail the call; the robot did not ask for it and need not know."""
        answer = self._calls.get(msg_id)
        if answer is not None and not answer.done():
            answer.set_exception(PeerFault(problem))

    def _fail_all(self, error: CallError) -> None:
        for answer in self._calls.values():
            if not answer.done():
                answer.set_exception(error)


def make_interface(
    role: Role, port: Port, robot: RobotSide, form_in: Form, form_out: Form, *, call_timeout: float
) -> RobotInterface:
    """Make the robot's end of an interface of the given role."""
    match role:
        case Role.SUBSCRIBER:
            return FromRobot(port, robot, form_in, form_out)
        case Role.PUBLISHER:
            return ToRobot(port, robot, form_in, form_out)
        case Role.SERVICE_PROVIDER:
            return AskedByRobot(port, robot, form_in, form_out)
        case Role.SERVICE_CLIENT:
            return AnsweredByRobot(port, robot, form_in, form_out, call_timeout=call_timeout)
