"""A process that makes plans, so that the planner's event loop can handle poses and requests meanwhile.

It is a process and not a thread: planning is Python code that holds the interpreter lock for milliseconds,
triggers garbage collection in the event loop, and would share one core with the thousands of poses per second
of a large fleet. The messages are small: a request with a few numbers per robot, and a result with two
numbers for each step of a robot.

The process reads requests from its standard input and ends with it.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from asyncio.subprocess import PIPE, Process
from typing import TYPE_CHECKING, BinaryIO, Self

import msgspec

from rce_fleet.coordination.replanning import PlanRequest, PlanResult, compute_plan
from rce_fleet.exceptions import PlanWorkerError

if TYPE_CHECKING:
    import logging
    from types import TracebackType

_LENGTH = 4
"""Bytes of the length in front of each message."""
_ENDING_S = 5.0
"""How long a process whose output ended may take to end."""


class PlanWorker:
    """The planner node's handle of the process; ``async with`` starts and ends it.

    Args:
        log: Logs restarts of the process.
        command: Command of the process.
    """

    def __init__(self, log: logging.Logger, *, command: tuple[str, ...] = ()) -> None:
        self._log = log
        self._command = command or (sys.executable, "-P", "-m", __name__)
        self._process: Process | None = None

    async def __aenter__(self) -> Self:
        await self._start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._end()

    async def compute(self, request: PlanRequest) -> PlanResult:
        """Return a plan. If the process ends, it is restarted once.

        Cancelling leaves the process in the middle of its work: end it afterwards.

        Raises:
            PlanWorkerError: The process ended twice over this request.
        """
        try:
            return await self._ask(request)
        except (asyncio.IncompleteReadError, ConnectionError):
            self._log.warning("the plan worker ended (%s); restarting it", await self._end(_ENDING_S))
        await self._start()
        try:
            return await self._ask(request)
        except (asyncio.IncompleteReadError, ConnectionError) as error:
            status = await self._end(_ENDING_S)
            raise PlanWorkerError(request.number, len(request.robots), status) from error

    async def _start(self) -> None:
        self._process = await asyncio.create_subprocess_exec(*self._command, stdin=PIPE, stdout=PIPE)

    async def _end(self, grace: float = 0.0) -> str:
        """End the process, after ``grace`` seconds; return how it ended, in words.

        A process that ends by itself needs the grace: to kill it would take its status from asyncio.
        """
        process, self._process = self._process, None
        if process is None:
            return "it was ended"
        try:
            async with asyncio.timeout(grace):
                status = await process.wait()
        except TimeoutError:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            status = await process.wait()
        return f"signal {-status}" if status < 0 else f"status {status}"

    async def _ask(self, request: PlanRequest) -> PlanResult:
        process = self._process
        if process is None:
            raise ConnectionResetError("the process was ended")
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(_frame(msgspec.msgpack.encode(request)))
        await process.stdin.drain()
        length = int.from_bytes(await process.stdout.readexactly(_LENGTH))
        return msgspec.msgpack.decode(await process.stdout.readexactly(length), type=PlanResult)


def serve(requests: BinaryIO, results: BinaryIO) -> None:
    """Make plans until the input ends."""
    while len(head := requests.read(_LENGTH)) == _LENGTH:
        payload = requests.read(int.from_bytes(head))
        result = compute_plan(msgspec.msgpack.decode(payload, type=PlanRequest))
        results.write(_frame(msgspec.msgpack.encode(result)))
        results.flush()


def _frame(payload: bytes) -> bytes:
    return len(payload).to_bytes(_LENGTH) + payload


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the node, which then ends this process.
    with contextlib.suppress(BrokenPipeError):
        serve(sys.stdin.buffer, sys.stdout.buffer)
