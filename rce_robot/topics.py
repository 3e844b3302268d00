"""The robot's end of topics, in both directions."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from rce.protocol.messages import NO_ID
from rce_robot.conversion import ConversionQueue
from rce_robot.exceptions import BusyError, MisdirectedError, UnreadableError
from rce_robot.interface import Delivery, RobotInterface
from rce_robot.offload import Read, pack_value
from rce_robot.outbox import Outgoing, Overflow

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from rce.guard.holdings import Holding
    from rce.link import Port
    from rce.protocol.messages import DataMessage
    from rce.protocol.stream import LargeData
    from rce_robot.forms import Form
    from rce_robot.interface import RobotSide


class FromRobot(RobotInterface):
    """Subscriber: what the robot says goes to every peer."""

    def __init__(self, port: Port, robot: RobotSide, form_in: Form, form_out: Form) -> None:
        super().__init__(port, robot, form_in, form_out)
        self._queue = ConversionQueue[tuple[Read, str]](robot, self._send, self._dropped)

    def take(self, message: DataMessage) -> None:
        """Send it on."""
        if not (self.form_in.costly or self._queue.busy):
            self.port.send(self._read(message, self._warn))
            return
        try:
            packed = pack_value(message.msg)
        except UnreadableError as error:
            raise UnreadableError(f"{self._name(message.msg_id)}: {error}") from error
        self._put(len(packed), partial(self._convert_value, packed, message.msg_id))

    def take_large(self, large: LargeData) -> None:
        """Send it on when it has been converted; what comes after it waits for that."""
        self._put(large.size, partial(self._convert_text, large))

    def robot_left(self) -> None:
        """Forget what waits to be converted."""
        self._queue.clear()

    def _put(self, size: int, work: partial[Coroutine[Any, Any, tuple[Read, str]]]) -> None:
        if not self._queue.put(size, work):
            raise BusyError(f"{self.tag}: messages come faster than they can be converted; one was dropped")

    async def _convert_value(self, packed: bytes, msg_id: str) -> tuple[Read, str]:
        return await self.offload.read_value(packed), msg_id

    async def _convert_text(self, large: LargeData) -> tuple[Read, str]:
        read = await self.read_large(large)
        return read, read.msg_id or large.address.msg_id

    def _send(self, converted: tuple[Read, str]) -> None:
        read, msg_id = converted
        if read.fault or read.text is not None:
            problem = read.fault or "a string is not an object of the fields of the message"
            self.robot.report(f"{self._name(msg_id)}: {problem}")
        for warning in read.warnings:
            self._warn(warning)
        if read.payload is not None:
            self.port.send(read.payload)

    def _dropped(self) -> None:
        self.robot.report(f"{self.tag}: memory is short; a message that waited to be converted was dropped")


class ToRobot(RobotInterface):
    """Publisher: what the peers say goes to the robot.

    The last latched message is kept and given again to a robot that comes back, as a latched topic does to
    every new subscriber. Other messages that come while the robot is away are dropped.
    """

    def __init__(self, port: Port, robot: RobotSide, form_in: Form, form_out: Form) -> None:
        super().__init__(port, robot, form_in, form_out)
        self._latched: bytes | None = None
        self._latched_holding: Holding | None = None
        self._queue = ConversionQueue[tuple[Outgoing | None, str, bool]](
            robot, self._send_shown, self._dropped
        )

    def take(self, message: DataMessage) -> None:
        """Refuse it."""
        raise MisdirectedError(f"{self._name(message.msg_id)}: the interface takes nothing from the robot")

    def receive(self, payload: bytes, *, latched: bool) -> None:
        """Send a peer's message to the robot."""
        if latched:
            self._forget_latched()
            self._latched = payload
            self._latched_holding = self.robot.hold(len(payload), self._give_up_latched)
        self._send(payload, latched=latched)

    def robot_joined(self) -> None:
        """Also give it the last latched message."""
        super().robot_joined()
        if self._latched is not None:
            self._send(self._latched, latched=True)

    def robot_left(self) -> None:
        """Forget what waits to be converted."""
        self._queue.clear()

    async def close(self) -> None:
        """Forget the latched message too."""
        await super().close()
        self._forget_latched()

    def _forget_latched(self) -> None:
        self._latched = None
        if self._latched_holding is not None:
            self._latched_holding.release()
            self._latched_holding = None

    def _give_up_latched(self) -> None:
        """Memory is short: the message is lost, which the robot's user must know."""
        self._latched = self._latched_holding = None
        self.robot.drop_latched(self.tag)
        self.robot.count_dropped(self.tag)
        self.robot.report(f"{self.tag}: memory is short; the latched message was dropped")

    def _send(self, payload: bytes, *, latched: bool) -> None:
        if self._queue.busy or self.form_out.is_heavy(payload):
            if self.robot.connected and not self._queue.put(
                len(payload), partial(self._show, payload, latched=latched)
            ):
                self.robot.count_dropped(self.tag)
        elif latched:
            self.robot.send_latched(self.tag, Delivery(self, payload, NO_ID), shared=True)
        else:
            self.robot.send_data(self.tag, Delivery(self, payload, NO_ID), Overflow.DROP_OLDEST)

    async def _show(self, payload: bytes, *, latched: bool) -> tuple[Outgoing | None, str, bool]:
        try:
            return await self.offload.show(payload, NO_ID), "", latched
        except UnreadableError as error:
            return None, str(error), latched

    def _send_shown(self, converted: tuple[Outgoing | None, str, bool]) -> None:
        outgoing, problem, latched = converted
        if outgoing is None:
            self.not_rendered(NO_ID, problem)
        elif latched:
            self.robot.send_latched(self.tag, outgoing, shared=False)
        else:
            self.robot.send_data(self.tag, outgoing, Overflow.DROP_OLDEST)

    def _dropped(self) -> None:
        self.robot.count_dropped(self.tag)
