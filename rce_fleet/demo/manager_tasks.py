"""A stream of tasks for the fleet manager: loads that are picked in one cell and delivered in another.

Requests go to the station's API, as those of an ERP do. Each has a key, with which it is sent again until it
is answered; the manager creates one task for it. Events tell what becomes of tasks. At the end the manager is
asked for all of them: what it knows then is what counts.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import time
from typing import TYPE_CHECKING, NamedTuple, Self

from rce.aio.tasks import cancel_and_wait
from rce_fleet.api.tasks import StopModel, TaskRequest
from rce_fleet.client import ApiError, FleetApiUnavailableError, FleetClient
from rce_fleet.tasks.tables import WITH_ROBOT

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from random import Random
    from types import TracebackType

    from rce_fleet.api.fleet import EventModel
    from rce_fleet.api.tasks import TaskModel
    from rce_fleet.station.api import FleetModel

MORE_THAN_ROBOTS = 1.1
"""Open tasks for each robot: some wait, so that no robot has to."""
ACTION_S = 2.0
"""How long a load is picked or delivered, seconds."""
AT_ONCE = 8
"""Requests that are under way at the same time, at most."""
AGAIN_S = 1.0
"""Pause before requests without an answer are sent again."""
COMPARE_S = 20.0
"""Seconds after which the manager is asked for its open tasks, in case events were missed."""
SETTLE_S = 60.0
"""How long the manager is asked at the end, if it does not answer."""
WORKING = frozenset(state.value for state in WITH_ROBOT)
"""States in which a robot has something to do, also if it cannot continue now."""
ENDED = frozenset({"done", "failed", "cancelled"})


class _Seen(NamedTuple):
    """The newest that is known of a task."""

    revision: int
    state: str
    robot: str
    text: str


class ManagerTasks:
    """Keeps a number of transports open at the fleet manager. An async context manager.

    Args:
        page: URL of the station.
        cells: Where loads are picked and delivered.
        rng: Draws the cells.
        robots: Number of robots.
    """

    def __init__(self, page: str, cells: Sequence[int], rng: Random, robots: int) -> None:
        self._client = FleetClient(page)
        self._cells = cells
        self._rng = rng
        # Each task has two cells of its own.
        self._most = max(1, min(round(MORE_THAN_ROBOTS * robots) + 1, len(cells) // 2))
        self._run = secrets.token_hex(4)
        self._count = 0
        self._waiting: dict[str, TaskRequest] = {}
        """Requests that are not answered yet, by key."""
        self._wanted = asyncio.Event()
        self._accepted: dict[str, frozenset[int]] = {}
        """The cells of accepted tasks, by id."""
        self._seen: dict[str, _Seen] = {}
        self._lost: list[str] = []
        self._refused: list[str] = []
        self._unsettled = ""
        self._work: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        await self._client.__aenter__()
        self._work = [asyncio.create_task(work) for work in (self._follow(), self._send(), self._compare())]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stop()
        await self._client.__aexit__(kind, error, trace)

    @property
    def accepted(self) -> int:
        """Number of tasks that the manager accepted."""
        return len(self._accepted)

    @property
    def done(self) -> int:
        """Number of those that are done."""
        return sum(self._state(task) == "done" for task in self._accepted)

    @property
    def open(self) -> int:
        """Number of tasks that are accepted, and have not ended."""
        return len(self._open())

    @property
    def lost(self) -> Sequence[str]:
        """Tasks that the manager accepted and does not know at the end."""
        return self._lost

    @property
    def failed(self) -> Sequence[str]:
        """Tasks that failed or were cancelled, refused requests, and what could not be found out."""
        ends = [
            f"{task} is {self._state(task)} ({self._seen[task].text})"
            for task in self._accepted
            if self._state(task) in ("failed", "cancelled")
        ]
        return [*ends, *self._refused, *([self._unsettled] if self._unsettled else [])]

    @property
    def busy(self) -> Collection[str]:
        """Robots that carry out a task."""
        return {self._seen[task].robot for task in self._open() if self._state(task) in WORKING}

    async def update(self, fleet: FleetModel, *, more: bool) -> None:
        """Prepare new tasks; they are sent meanwhile.

        Args:
            fleet: The state of the fleet: nothing is sent to cells that are blocked in it.
            more: Whether to send new tasks.
        """
        for work in self._work:
            if work.done():
                work.result()  # it has no end but an error
        if not more:
            return
        taken = {*fleet.blocked, *fleet.pending}
        taken.update(cell for task in self._open() for cell in self._accepted[task])
        taken.update(cell for request in self._waiting.values() for cell in _cells(request))
        free = [cell for cell in self._cells if cell not in taken]
        missing = min(self._most - self.open - len(self._waiting), len(free) // 2)
        if missing <= 0:
            return
        drawn = self._rng.sample(free, 2 * missing)
        for pick, deliver in zip(drawn[::2], drawn[1::2], strict=True):
            self._count += 1
            stops = [
                StopModel(action="pick", cell=pick, duration=ACTION_S),
                StopModel(action="deliver", cell=deliver, duration=ACTION_S),
            ]
            key = f"demo-{self._run}-{self._count}"
            self._waiting[key] = TaskRequest(stops=stops, name=f"transport {self._count}", key=key)
        self._wanted.set()

    async def settle(self) -> None:
        """Compare the tasks that were accepted with those that the manager knows; wait until it answers."""
        await self._stop()
        deadline = time.monotonic() + SETTLE_S
        while True:
            try:
                await self._settle()
            except (FleetApiUnavailableError, ApiError) as error:
                if time.monotonic() < deadline:
                    await asyncio.sleep(AGAIN_S)
                    continue
                self._unsettled = f"the fleet manager could not be asked for its tasks: {error}"
            return

    async def _settle(self) -> None:
        known = {task.id: task async for task in self._client.tasks()}
        for task in known.values():
            self._take(task)
            if (request := self._waiting.pop(task.key, None)) is not None:
                self._accepted[task.id] = _cells(request)  # only the answer did not arrive
        lost = []
        for task_id in sorted(self._accepted.keys() - known.keys()):
            # The manager forgets tasks that have ended when there are very many; its journal has their end.
            history = [event async for event in self._client.history(subject=task_id)]
            if not any(event.state in ENDED for event in history):
                lost.append(task_id)
        self._lost = lost

    def _state(self, task: str) -> str:
        return self._seen[task].state

    def _open(self) -> Collection[str]:
        return [task for task in self._accepted if self._state(task) not in ENDED]

    def _take(self, task: TaskModel) -> None:
        self._note(task.id, _Seen(task.revision, task.state, task.robot_assigned, task.reason))

    def _note(self, task_id: str, seen: _Seen) -> None:
        """Take what an answer or an event tells, unless something newer is known."""
        known = self._seen.get(task_id)
        if known is None or seen.revision >= known.revision:
            self._seen[task_id] = seen

    # Beside the run

    async def _follow(self) -> None:
        """Take events."""
        event: EventModel
        async for event in self._client.events():
            if event.kind == "task":
                self._note(event.id, _Seen(event.revision, event.state, event.robot, event.text))

    async def _send(self) -> None:
        """Send the requests that wait, until they are answered."""
        slots = asyncio.Semaphore(AT_ONCE)

        async def send(key: str) -> None:
            async with slots:
                try:
                    task = await self._client.create_task(self._waiting[key], key=key)
                except FleetApiUnavailableError:
                    return  # it is sent again
                except ApiError as error:
                    self._refused.append(f"request {key} was refused: {error}")
                    del self._waiting[key]
                    return
                self._take(task)
                self._accepted[task.id] = _cells(self._waiting.pop(key))

        while True:
            await self._wanted.wait()
            self._wanted.clear()
            await asyncio.gather(*map(send, list(self._waiting)))
            if self._waiting:
                await asyncio.sleep(AGAIN_S)
                self._wanted.set()

    async def _compare(self) -> None:
        """Ask for tasks that are open as far as events tell."""
        while True:
            await asyncio.sleep(COMPARE_S)
            with contextlib.suppress(FleetApiUnavailableError):
                still = {task.id: task async for task in self._client.tasks(state=["open"])}
                for task in still.values():
                    self._take(task)
                for task_id in [task for task in self._open() if task not in still]:
                    with contextlib.suppress(ApiError):  # the manager does not know it: see at the end
                        self._take(await self._client.task(task_id))

    async def _stop(self) -> None:
        for work in self._work:
            await cancel_and_wait(work)
        self._work = []


def _cells(request: TaskRequest) -> frozenset[int]:
    """Return the cells of a task's stops."""
    return frozenset(stop.cell for stop in request.stops if stop.cell is not None)
