"""A process that makes plans, so that the planner's event loop can handle poses and requests meanwhile.

It is a process and not a thread: planning is Python code that holds the interpreter lock for milliseconds,
triggers garbage collection in the event loop, and would share one core with the thousands of poses per second
of a large fleet. The messages are small: a request with a few numbers per robot, and a result with two
numbers for each step of a robot.

The process reads requests from its standard input and ends with it. A few robots on a small map need no
compiled loops. For larger fleets and maps a process loads the planner's inner loops from numba's cache, which
takes a second or two; the first large request waits for it. If the cache does not have them (``rce compile``
fills it), another process compiles them. Robots must not stand for this half a minute: plans are made with
the plain forms meanwhile. Then a process with compiled loops takes over. On the volume ``fleet`` the cache
outlives the container.

A planner of another package may never return, and a process may be stopped. So the time of a plan is limited;
then the process is ended, and the robots continue without this plan.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import signal
import sys
import threading
import traceback
from asyncio.subprocess import PIPE, Process
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Self

import msgspec

from rce_fleet.compiled import COMPILED, compile_kernels, is_available, load_kernels
from rce_fleet.coordination.replanning import PlanRequest, PlanResult, compute_plan
from rce_fleet.coordination.rerouting import Rerouting
from rce_fleet.coordination.settings import COMPILED_EFFORT, PLAN_TIMEOUT
from rce_fleet.exceptions import PlanWorkerError
from rce_fleet.nodes.known_robots import VOLUME_VARIABLE
from rce_fleet.nodes.worker_process import ask, end, frame, how_ended, receive, requests_of
from rce_fleet.planning.path_improvement import PATH_IMPROVEMENT_KERNELS
from rce_fleet.planning.planner import BUILT_IN_PLANNERS, DEFAULT_PLANNER, Planner, load_planner
from rce_fleet.planning.rerouting import REROUTING_KERNELS

if TYPE_CHECKING:
    import logging
    from types import TracebackType

DRIVING_KERNELS = (*REROUTING_KERNELS, *PATH_IMPROVEMENT_KERNELS)
"""Loops for robots that drive, beside those of the default planner."""
_ENDING_S = 5.0
"""How long a process whose output ended may take to end."""
_CACHE_VARIABLE = "NUMBA_CACHE_DIR"
_CACHE = "compiled"
"""Folder on the volume for compiled loops."""
_FILL = "--compile"
_CACHED = "--cached"
"""Option of a process that ends unless the cache has all loops."""
_LOAD_S = 15.0
"""How long a large request waits for loops from the cache; on an idle machine they take a second or two."""
_ROBOTS_PER_TIMEOUT = 500
"""The time for a plan grows by the timeout for so many robots each."""
_BETTER_S = 5.0
"""How much longer than asked for the process may look for better paths: robots can do without."""
_NEW_PATHS_S = 15.0
"""How long it may look for new paths of some robots; if it finds none, one plan is made for all."""
_ROBOTS = 20
_CELLS = 10_000
"""Loops are compiled for requests with at least so many robots, or cells; they take 150 MB."""
_LEAST_PRIORITY = 19


class PlanWorker:
    """The planner node's handle of the process; ``async with`` starts and ends it.

    Args:
        log: Logs restarts of the process.
        command: Command of the process.
        compiled: Whether a process with compiled loops takes over; None: if numba is installed.
        timeout: Seconds for the plan of a few robots at most; larger fleets get more, see :meth:`time_for`.

    Attributes:
        timeout: See above.
    """

    def __init__(
        self,
        log: logging.Logger,
        *,
        command: tuple[str, ...] = (),
        compiled: bool | None = None,
        timeout: float = PLAN_TIMEOUT,
    ) -> None:
        self._log = log
        self.timeout = timeout
        self._command = command or (sys.executable, "-P", "-m", __name__)
        self._to_compile = is_available() if compiled is None else compiled
        self._is_compiled = False
        self._process: Process | None = None
        self._next: Process | None = None
        """Compiles, or has compiled loops and is not asked yet."""
        self._compiling: asyncio.Task[None] | None = None
        self._cache_tried = asyncio.Event()
        """Set when the loops are loaded from the cache, or it is known that it does not have them."""

    @property
    def is_compiled(self) -> bool:
        """Whether the next plan is made with compiled loops."""
        ready = self._compiling is not None and self._compiling.done() and self._next is not None
        return self._is_compiled or ready

    async def __aenter__(self) -> Self:
        await self._start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._compiling is not None:
            self._compiling.cancel()
            await asyncio.wait([self._compiling])
        await self._end()
        self._process, self._next = self._next, None
        await self._end()

    def prepare(self, robots: int, cells: int) -> None:
        """Begin to load or compile the loops if a fleet or its map is so large; call it as soon as you know.

        Args:
            robots: Number of robots.
            cells: Number of cells of the map.
        """
        if self._to_compile and is_large(robots, cells):
            self._to_compile = False
            self._compiling = asyncio.create_task(self._compile())

    def time_for(self, robots: int) -> float:
        """Return how many seconds a plan for so many robots may take."""
        return self.timeout * (1 + robots / _ROBOTS_PER_TIMEOUT)

    def limit_for(self, request: PlanRequest) -> float:
        """Return how many seconds the answer to a request may take."""
        longest = self.time_for(len(request.robots))
        if request.improve_seconds:
            return min(longest, request.improve_seconds + _BETTER_S)
        return longest if request.copy is None else min(longest, _NEW_PATHS_S)

    async def _compile(self) -> None:
        """Prepare a process with compiled loops."""
        try:
            self._next = await self._spawn(_CACHED, compiled=True)
            if not await _is_ready(self._next):
                await self._next.wait()
                self._cache_tried.set()
                self._next = await self._spawn(_FILL, compiled=True)
                await self._next.wait()
                self._next = await self._spawn(compiled=True)
                if not await _is_ready(self._next):
                    status = how_ended(await self._next.wait())
                    self._next = None
                    self._log.warning(
                        "plans are made without compiled loops: their process ended (%s)", status
                    )
                    return
        except OSError as error:
            self._next = None
            self._log.warning("plans are made without compiled loops: %s", error)
        else:
            self._log.info("plans are made with compiled loops from now on")
        finally:
            self._cache_tried.set()

    async def _await_cache(self) -> None:
        """Wait for loops that are being loaded from the cache, for a limited time, and once only."""
        try:
            async with asyncio.timeout(_LOAD_S):
                await self._cache_tried.wait()
        except TimeoutError:
            self._cache_tried.set()
            self._log.info("compiled loops take long to load: plans are made without them meanwhile")

    async def _take_compiled(self) -> None:
        """Ask the process with compiled loops from now on, if it is ready."""
        if self._compiling is not None and self._compiling.done():
            self._compiling = None
            if self._next is not None:
                await self._end()
                self._process, self._next = self._next, None
                self._is_compiled = True

    async def compute(self, request: PlanRequest) -> PlanResult:
        """Return a plan. If the process ends, it is restarted once.

        If the planner fails, its plan cannot be carried out, or it takes longer than :meth:`limit_for`
        allows, this is logged, and the plan has no visits: robots keep their paths if better ones were asked
        for, and one plan for all follows if new ones of some were. After a plan for all of another package's
        planner the default one is asked; otherwise they stand until single robots find paths, or something
        changes.

        Cancelling leaves the process in the middle of its work: end it afterwards.

        Raises:
            PlanWorkerError: The process ended twice over this request.
        """
        robots, cells = len(request.robots), request.rows * request.columns
        self.prepare(robots, cells)
        if self._compiling is not None and is_large(robots, cells):
            await self._await_cache()
        await self._take_compiled()
        try:
            async with asyncio.timeout(self.time_for(robots)) as limit:
                result = await self._ask_twice(request, limit)
        except TimeoutError:
            await self._end()
            return self._give_up(request)
        if result.failure:
            self._log.error(
                "the planner %r failed in plan %d for %d robots: %s; %s (the traceback of an exception is on"
                " stderr)",
                *(request.planner, request.number, robots, result.failure, what_follows(request)),
            )
        return result

    def _give_up(self, request: PlanRequest) -> PlanResult:
        """Log that a request took too long; return the answer without its result."""
        robots, seconds = len(request.robots), self.limit_for(request)
        if request.improve_seconds:
            self._log.warning(
                "the plan process looked for better paths for more than %.0f s and was ended;"
                " robots keep their paths",
                seconds,
            )
            return nothing_better(request)
        if request.copy is not None:
            self._log.warning(
                "the plan process found no new paths for %d of %d robots within %.0f s and was ended;"
                " one plan is made for all",
                *(len(request.copy.members), robots, seconds),
            )
        else:
            self._log.error(
                "the planner %r made no plan %d for %d robots within %.0f s; it was ended, and %s. If it"
                " needs more time, set the parameter plan_timeout; if it never ends, set the parameter"
                " planner to another one",
                *(request.planner, request.number, robots, seconds, what_follows(request)),
            )
        return failed_plan(request, f"it took longer than {seconds:.0f} s")

    async def _ask_twice(self, request: PlanRequest, limit: asyncio.Timeout) -> PlanResult:
        try:
            return await self._ask(request, limit)
        except (asyncio.IncompleteReadError, ConnectionError):
            self._log.warning("the plan worker ended (%s); restarting it", await self._end(_ENDING_S))
        try:
            return await self._ask(request, limit)
        except (asyncio.IncompleteReadError, ConnectionError) as error:
            status = await self._end(_ENDING_S)
            raise PlanWorkerError(request.number, len(request.robots), status) from error

    async def _start(self) -> Process:
        process = self._process = await self._spawn(compiled=self._is_compiled)
        if self._is_compiled and not await _is_ready(process):
            raise ConnectionResetError("the process ended while it loaded its loops")
        return process

    async def _spawn(self, *options: str, compiled: bool) -> Process:
        variables = dict(os.environ)
        if not compiled:
            variables[COMPILED] = "no"
        elif (volume := os.environ.get(VOLUME_VARIABLE, "")) and _CACHE_VARIABLE not in variables:
            variables[_CACHE_VARIABLE] = str(Path(volume, _CACHE))
        command = (*self._command, *options)
        return await asyncio.create_subprocess_exec(*command, stdin=PIPE, stdout=PIPE, env=variables)

    async def _end(self, grace: float = 0.0) -> str:
        """End the process, after ``grace`` seconds; return how it ended, in words."""
        process, self._process = self._process, None
        return "it was ended" if process is None else await end(process, grace)

    async def _ask(self, request: PlanRequest, limit: asyncio.Timeout) -> PlanResult:
        loop = asyncio.get_running_loop()
        process = self._process
        if process is None:  # To load its loops may take longer than the limit of the request.
            limit.reschedule(loop.time() + self.time_for(len(request.robots)))
            process = await self._start()
        limit.reschedule(loop.time() + self.limit_for(request))
        return msgspec.msgpack.decode(await ask(process, msgspec.msgpack.encode(request)), type=PlanResult)


async def _is_ready(process: Process) -> bool:
    """Wait until a process has its compiled loops; return False if it ended instead."""
    try:
        await receive(process)
    except asyncio.IncompleteReadError:
        return False
    return True


def what_follows(request: PlanRequest) -> str:
    """Return what happens without the plan of a request, in words."""
    if request.planner in BUILT_IN_PLANNERS:
        return "robots only get single paths until the next plan"
    return f"{DEFAULT_PLANNER} makes the plans for a while"


def is_large(robots: int, cells: int) -> bool:
    """Return whether compiled loops are worth their memory for so many robots, or cells of a map."""
    return robots >= _ROBOTS or cells >= _CELLS


def serve(requests: BinaryIO, results: BinaryIO) -> None:
    """Make plans until the input ends; an empty frame first says that the loops are compiled, if they are.

    A planner that raises an exception does not end the process, and is loaded anew for the next plan.
    """
    planners: dict[str, Planner] = {}
    compiled = is_available()
    if compiled:
        planners[DEFAULT_PLANNER] = load_compiled()
        results.write(frame(b""))
        results.flush()
    gc.collect()
    gc.freeze()  # Compiled loops are many objects: a full collection would take longer than most plans.
    for payload in requests_of(requests):
        request = msgspec.msgpack.decode(payload, type=PlanRequest)
        if compiled:  # compiled loops do so much more in the same time
            request = replace(request, effort=max(request.effort, COMPILED_EFFORT))
        try:
            if request.improve_seconds and not compiled:  # too slow to find anything in the time
                results.write(frame(msgspec.msgpack.encode(nothing_better(request))))
                results.flush()
                continue
            if not compiled and request.copy is None and is_large(len(request.robots), 0):
                request = replace(request, quarter_turn=0.0, stop=0.0)  # turns take ten times as long
            if request.planner not in planners:
                planners[request.planner] = load_planner(request.planner)
            result = compute_plan(request, planners[request.planner])
        except Exception as error:  # noqa: BLE001 - a planner is code of others
            traceback.print_exc()
            planners.pop(request.planner, None)
            result = failed_plan(request, f"{type(error).__name__}: {error}")
        results.write(frame(msgspec.msgpack.encode(result)))
        results.flush()


def nothing_better(request: PlanRequest) -> PlanResult:
    """Return the answer to a request for better paths where all robots keep theirs."""
    return PlanResult(request.number, (), (), (), complete=True, rerouting=Rerouting(found=True))


def failed_plan(request: PlanRequest, failure: str) -> PlanResult:
    """Return the answer to a request that no plan was made for; after new paths one plan for all follows."""
    rerouting = Rerouting(found=False) if request.copy is not None else None
    return PlanResult(request.number, (), (), (), complete=False, rerouting=rerouting, failure=failure)


def load_cached() -> bool:
    """Use compiled loops if the cache has all that plans need; return whether it has."""
    from rce_fleet.planning.lacam import KERNELS

    return load_kernels((*KERNELS, *DRIVING_KERNELS))


def load_compiled() -> Planner:
    """Compile the loops, and return the default planner."""
    compile_kernels(DRIVING_KERNELS)
    return load_planner(DEFAULT_PLANNER)


def end_with_input() -> None:
    """End this process when its input ends, in the middle of compiling too: the node was killed."""
    # Not by sys.stdin: its lock would be held while the interpreter ends, which then aborts.
    while os.read(sys.stdin.fileno(), 1024):
        pass
    os._exit(0)


def main() -> None:
    """Make plans; with an option of the command line, fill the cache, or only if the cache is filled."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the node, which then ends this process.
    if _FILL in sys.argv:
        os.nice(_LEAST_PRIORITY)
        threading.Thread(target=end_with_input, daemon=True).start()
        load_compiled()
        return
    if _CACHED in sys.argv and not load_cached():
        return
    with contextlib.suppress(BrokenPipeError):
        serve(sys.stdin.buffer, sys.stdout.buffer)


if __name__ == "__main__":
    main()
