"""The robot's end of topics, in both directions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce.protocol.messages import NO_ID
from rce_robot.conveyor import Conveyor
from rce_robot.exceptions import BusyError, MisdirectedError, UnreadableError
from rce_robot.interface import Delivery, RobotInterface
from rce_robot.outbox import Overflow

if TYPE_CHECKING:
    from rce.link import Port
    from rce.protocol.messages import DataMessage
    from rce_robot.forms import Form
    from rce_robot.interface import RobotSide
    from rce_robot.outbox import Buffer


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
