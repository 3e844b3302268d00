"""Looks for better queues beside a fleet manager, if OR-Tools is installed: ``pip install 'rce[routing]'``.

The search takes a part of a second of a processor, so another process does it, with a low priority: the
manager answers meanwhile. It is started once tasks wait in the queues of several robots, and ends with its
input.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
from asyncio.subprocess import PIPE, Process
from importlib.util import find_spec
from typing import TYPE_CHECKING, BinaryIO

import msgspec

from rce_fleet.exceptions import BatchWorkerError
from rce_fleet.nodes.worker_process import ask, end, frame, requests_of
from rce_fleet.tasks.routing_problem import RoutingProblem

if TYPE_CHECKING:
    import logging

    from rce_fleet.manager.manager import FleetManager

Routes = list[list[int]]

SEARCH_S = 0.01
"""Seconds of a processor for the search, for each task of a batch."""
ANSWER_S = 120.0
"""A search that takes so long on a busy machine is given up."""
RESTART_S, MOST_RESTART_S = 60.0, 3600.0
"""After the process failed, no batch is tried for this time; twice as long each time that it fails again."""
_ENDING_S = 5.0
"""How long a process whose output ended may take to end."""
_NICE = 10


def is_available() -> bool:
    """Return whether OR-Tools is installed."""
    return find_spec("ortools") is not None


async def improve_queues(manager: FleetManager, log: logging.Logger, every: float) -> None:
    """Look for better queues again and again, until this is cancelled.

    Args:
        manager: Its queues are changed.
        log: Says once that no better queues are looked for, if the process ends again and again.
        every: Seconds from the end of a search to the next one.
    """
    worker = BatchWorker()
    pause = 0.0
    try:
        while True:
            await asyncio.sleep(every + pause)
            dispatcher = manager.dispatcher
            batch = dispatcher.batch(manager.clock(), manager.facts)
            if batch is None:
                continue
            try:
                routes = await worker.improve(batch.problem)
            except BatchWorkerError as error:
                if not pause:
                    log.warning("queued tasks keep their robots: %s", error)
                pause = min(MOST_RESTART_S, 2 * pause or RESTART_S)
                continue
            pause = 0.0
            if routes is not None and manager.dispatcher is dispatcher:
                dispatcher.adopt(batch, routes)
    except Exception:
        log.exception("queued tasks keep their robots from now on: the search for better queues failed")
    finally:
        await worker.end()


class BatchWorker:
    """The handle of the process.

    Args:
        command: Command of the process.
    """

    def __init__(self, command: tuple[str, ...] = ()) -> None:
        self._command = command or (sys.executable, "-P", "-m", __name__)
        self._process: Process | None = None

    async def improve(self, problem: RoutingProblem) -> Routes | None:
        """Return better routes for a batch; None: no better ones were found.

        Cancelling leaves the process in the middle of its work: end it afterwards.

        Raises:
            BatchWorkerError: The process ended, cannot be started, or takes too long.
        """
        try:
            if self._process is None:
                self._process = await asyncio.create_subprocess_exec(*self._command, stdin=PIPE, stdout=PIPE)
            async with asyncio.timeout(ANSWER_S):
                answer = await ask(self._process, msgspec.msgpack.encode(problem))
        except TimeoutError as error:
            await self.end()
            raise BatchWorkerError(f"the search took longer than {ANSWER_S:.0f} s") from error
        except OSError as error:
            status = await self.end(_ENDING_S)
            raise BatchWorkerError(f"the process that searches failed: {error} ({status})") from error
        except asyncio.IncompleteReadError as error:
            status = await self.end(_ENDING_S)
            raise BatchWorkerError(
                f"the process that searches ended ({status}); see its output on stderr"
            ) from error
        try:
            return msgspec.msgpack.decode(answer, type=Routes | None)
        except msgspec.MsgspecError as error:
            await self.end()
            raise BatchWorkerError(f"the process that searches gave a wrong answer: {error}") from error

    async def end(self, grace: float = 0.0) -> str:
        """End the process, after ``grace`` seconds; return how it ended, in words."""
        process, self._process = self._process, None
        return "it was not started" if process is None else await end(process, grace)


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer until the input ends."""
    from rce_fleet.tasks.routing import improve

    for payload in requests_of(requests):
        problem = msgspec.msgpack.decode(payload, type=RoutingProblem)
        routes = improve(problem, SEARCH_S * len(problem.weights))
        answers.write(frame(msgspec.msgpack.encode(routes)))
        answers.flush()


def main() -> None:
    """Search for better queues with a low priority."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the node, which then ends this process.
    os.nice(_NICE)
    with contextlib.suppress(BrokenPipeError):
        serve(sys.stdin.buffer, sys.stdout.buffer)


if __name__ == "__main__":
    main()
