"""The robot's end of services, in both directions."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rce.link import CallError, CallTimeout, Overloaded, PeerFault, PeerLost
from rce_robot.exceptions import BusyError, MisdirectedError, UnreadableError
from rce_robot.forms import fresh_id
from rce_robot.interface import RobotInterface

if TYPE_CHECKING:
    from rce.link import Port
    from rce.protocol.messages import DataMessage
    from rce_robot.forms import Form
    from rce_robot.interface import RobotSide
    from rce_robot.outbox import Buffer


_log = logging.getLogger(__name__)


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
        except Exception:  # noqa: BLE001 - logged; the caller must hear of the end of its call
            _log.exception("service call at %s", self.tag)
            self.robot.report(f"{self._name(msg_id)}: internal error; the engine's log tells more")
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

    def refused(self, msg_id: str, problem: str) -> None:
        """Fail the call: its answer is lost."""
        self.not_rendered(msg_id, f"the robot's answer was refused: {problem}")

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
