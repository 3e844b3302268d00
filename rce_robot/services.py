"""The robot's end of services, in both directions."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from functools import partial
from typing import TYPE_CHECKING, Any

from rce.link import CallError, CallTimeoutError, OverloadedError, PeerFaultError, PeerLostError, Port
from rce_robot.exceptions import BusyError, MisdirectedError, UnreadableError
from rce_robot.interface import RobotInterface, RobotSide
from rce_robot.outgoing import Buffer, fresh_id

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator

    from rce.protocol import DataMessage, LargeData
    from rce_robot.forms import Form
    from rce_robot.offload import Read
    from rce_robot.outgoing import Outgoing

_log = logging.getLogger(__name__)


class AskedByRobot(RobotInterface):
    """ServiceProvider: the robot calls the peer's service. Calls run concurrently."""

    def take(self, message: DataMessage) -> None:
        """Start a call."""
        if self.form_in.costly:
            packed = self._pack(message)
            read = partial(self.offload.read_value, packed)
            work = self._convert_and_call(read, message.msg_id, len(packed))
            self._run(work, message.msg_id)
        else:
            self._run(self._call(self._read(message, self._warn), message.msg_id), message.msg_id)

    def take_large(self, large: LargeData) -> None:
        """Start a call."""
        work = self._convert_and_call(partial(self.read_large, large), large.address.msg_id, large.size)
        self._run(work, large.address.msg_id)

    def _run(self, work: Coroutine[Any, Any, None], msg_id: str) -> None:
        if not self.robot.run(work):
            raise BusyError.at(self.tag, msg_id, "too many calls wait for an answer")

    async def _convert_and_call(
        self, reading: Callable[[], Coroutine[Any, Any, Read]], msg_id: str, size: int
    ) -> None:
        """Call with a request that another process converts."""
        with self._held(size, msg_id):
            read = await reading()
        msg_id = read.msg_id or msg_id
        for warning in read.warnings:
            self._warn(warning)
        if read.payload is not None:
            await self._call(read.payload, msg_id)
        elif not read.ids:
            problem = read.fault or "a string is not an object of the fields of the request"
            self._report(problem, msg_id)

    @contextlib.contextmanager
    def _held(self, size: int, msg_id: str) -> Iterator[None]:
        """Count the bytes of a call; when memory is short, the call ends."""
        task = asyncio.current_task()
        assert task is not None
        given_up = False

        def give_up() -> None:
            nonlocal given_up
            given_up = True
            task.cancel()

        holding = self.robot.hold(size, give_up)
        try:
            yield
        finally:
            holding.release()
            if given_up:
                self._report("memory is short; the call was given up", msg_id)

    async def _show_large(self, payload: Buffer, msg_id: str) -> Outgoing:
        """Convert an answer, which is counted meanwhile: at other times a queue holds it, and counts it."""
        with self._held(len(payload), msg_id):
            return await super()._show_large(payload, msg_id)

    async def _call(self, payload: Buffer, msg_id: str) -> None:
        try:
            with self._held(len(payload), msg_id):
                answer = await self.port.call(payload)
        except CallError as error:
            self._report(str(error), msg_id)
            return
        except Exception:  # noqa: BLE001 - logged; the caller must get an answer
            _log.exception("service call at %s", self.tag)
            self._report("internal error; the engine's log tells more", msg_id)
            return
        try:
            sent = await self._send_service(answer, msg_id)
        except UnreadableError as error:
            self._report(str(error), msg_id)
            return
        if not sent:
            self._report("the answer was dropped, too much waits to be sent", msg_id)


class AnsweredByRobot(RobotInterface):
    """ServiceClient: peers call the robot's service. Calls run concurrently."""

    def __init__(
        self, port: Port, robot: RobotSide, form_in: Form, form_out: Form, *, call_timeout: float
    ) -> None:
        super().__init__(port, robot, form_in, form_out)
        self._timeout = call_timeout
        self._calls: dict[str, asyncio.Future[Buffer]] = {}

    async def serve(self, payload: bytes) -> Buffer:
        """Ask the robot.

        Raises:
            CallError: It is away, leaves, is busy, answers with a fault, or does not answer in time.
        """
        if not self.robot.connected:
            raise PeerLostError("the robot is not connected")
        msg_id = fresh_id()
        answer: asyncio.Future[Buffer] = asyncio.get_running_loop().create_future()
        self._calls[msg_id] = answer
        try:
            async with asyncio.timeout(self._timeout):
                if not await self._send_service(payload, msg_id):
                    raise OverloadedError("too much waits to be sent to the robot")
                return await answer
        except UnreadableError as error:
            raise PeerFaultError(str(error)) from error
        except TimeoutError as error:
            raise CallTimeoutError(f"the robot did not answer within {self._timeout:g} s") from error
        finally:
            del self._calls[msg_id]
            del answer  # its error refers to this frame, and so to the request, until it is collected

    def take(self, message: DataMessage) -> None:
        """Complete a call. A string in place of ``msg`` is the robot's error text."""
        answer = self._calls.get(message.msg_id)
        if answer is None or answer.done():
            raise MisdirectedError.at(self.tag, message.msg_id, "no call waits for this answer")
        if isinstance(message.msg, str):
            answer.set_exception(PeerFaultError(message.msg))
            return
        try:
            if not self.form_in.costly:
                answer.set_result(self._read(message, self._warn))
                return
            packed = self._pack(message)
        except UnreadableError as error:
            answer.set_exception(PeerFaultError(f"the robot's answer cannot be read: {error}"))
            raise
        self._convert(self.offload.read_value(packed), message.msg_id, len(packed))

    def take_large(self, large: LargeData) -> None:
        """Complete a call when its answer has been converted."""
        if large.address.msg_id not in self._calls:
            raise MisdirectedError.at(self.tag, large.address.msg_id, "no call waits for this answer")
        self._convert(self.read_large(large), large.address.msg_id, large.size)

    def _convert(self, reading: Coroutine[Any, Any, Read], msg_id: str, size: int) -> None:
        if not self.robot.run(self._complete(reading, msg_id, size)):
            reading.close()
            problem = "too much is converted already"
            self.refused(msg_id, problem)
            raise BusyError.at(self.tag, msg_id, problem)

    async def _complete(self, reading: Coroutine[Any, Any, Read], msg_id: str, size: int) -> None:
        """Complete a call with an answer that another process converts."""
        holding = self.robot.hold(size)
        try:
            read = await reading
        finally:
            holding.release()
        answer = self._calls.get(read.msg_id or msg_id)
        if answer is None or answer.done() or read.ids:
            return
        for warning in read.warnings:
            self._warn(warning)
        if read.payload is not None:
            answer.set_result(read.payload)
        elif read.text is not None:
            answer.set_exception(PeerFaultError(read.text))
        else:
            answer.set_exception(PeerFaultError(f"the robot's answer cannot be read: {read.fault}"))
            self._report(read.fault, msg_id)

    def refused(self, msg_id: str, problem: str) -> None:
        """Fail the call: its answer is lost."""
        self.not_rendered(msg_id, f"the robot's answer was refused: {problem}")

    def robot_left(self) -> None:
        """Fail the waiting calls."""
        self._fail_all(PeerLostError("the robot's connection ended before it answered"))

    def not_rendered(self, msg_id: str, problem: str) -> None:
        """Fail the call without notifying the robot, which did not ask for it."""
        answer = self._calls.get(msg_id)
        if answer is not None and not answer.done():
            answer.set_exception(PeerFaultError(problem))

    def _fail_all(self, error: CallError) -> None:
        for answer in self._calls.values():
            if not answer.done():
                answer.set_exception(error)
