"""The owner of the state: applies commands one by one, stores their changes, and notifies listeners."""

from __future__ import annotations

import asyncio
import logging
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rce_master.exceptions import (
    EndedError,
    FencedError,
    MasterError,
    RefusedError,
    SaveTooLargeError,
    StoreError,
)
from rce_master.state.changes import Changes, Touched, make_row
from rce_master.state.commands import Continue, Tick
from rce_master.state.core import State, without_collections
from rce_master.state.migration import conversion
from rce_master.store.copying import check_finished

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator, Sequence

    from rce.control import EndpointSpec, SpecPatch
    from rce_master.leadership import Fence
    from rce_master.state.commands import Command
    from rce_master.state.settings import StateSettings
    from rce_master.state.tables import Tables
    from rce_master.store import Snapshot, Store

_log = logging.getLogger(__name__)

MAX_WAITING = 10_000
MAX_BATCH = 256
MAX_COMMANDS = 512
"""Approximate number of commands in one batch: so many wait for its last one before they are stored."""
MAX_HOLD_S = 0.01
"""Time after which input and output of the master go before the next command."""

Outcome = MasterError | None
"""The result of a command: None on success, else the error."""


@dataclass(slots=True)
class _Job:
    commands: Sequence[Command]
    done: asyncio.Future[list[Outcome]]
    outcomes: list[Outcome] = field(default_factory=list)


class _Turn:
    """A turn of the event loop."""

    def __init__(self) -> None:
        self._began = time.perf_counter()

    async def end_if_over(self) -> None:
        """Let everything else have its turn, if this one took long enough."""
        if time.perf_counter() - self._began >= MAX_HOLD_S:
            await asyncio.sleep(0)
            self._began = time.perf_counter()


class StateService:
    """Owns the state. Every change goes core -> store -> listeners, in this order.

    Commands that wait at the same time are stored in one transaction, so that a storm of logins costs one
    sync of the disk and not hundreds.

    Args:
        state: The state.
        store: Keeps what must survive.
        clock: Seconds that never go back.
        term: The term of the store in which this writes.
        fence: Tells whether this master leads; None if there is no other one.

    Attributes:
        listeners: Called with the changes of each command after they were stored; must not block or raise.
        reverts: How often changes were taken back, because they could not be stored.
    """

    def __init__(
        self,
        state: State,
        store: Store,
        clock: Callable[[], float] = time.monotonic,
        term: int = 0,
        fence: Fence | None = None,
    ) -> None:
        self.state = state
        self._fence = fence
        self._term = term
        self.listeners: list[Callable[[Changes], None]] = []
        self.reverts = 0
        self._settled = asyncio.Event()
        self._settled.set()
        self._store = store
        self._clock = clock
        self._jobs: asyncio.Queue[_Job] = asyncio.Queue(MAX_WAITING)
        self._store_fault = ""
        self._max_work = state.settings.max_work
        """Less than that of the settings after a save that was too large."""
        self._is_unfinished = False
        """Whether a command left work that is continued after the commands that wait."""
        self._end: StoreError | None = None
        """Why nothing is done any more."""

    @classmethod
    async def open(
        cls,
        store: Store,
        settings: StateSettings | None = None,
        clock: Callable[[], float] = time.monotonic,
        revision: int | None = None,
        fence: Fence | None = None,
        copy: Callable[[], Awaitable[State | None]] | None = None,
    ) -> StateService:
        """Go on from what a store holds, in a new term of it, or in that of a fence.

        Args:
            store: The store.
            settings: Limits and times.
            clock: Seconds; never goes back.
            revision: As :meth:`State.load` takes it; None is the time of day.
            fence: Of the leadership in which the store was opened, if there may be other masters.
            copy: Gives what was read of the store already, if it is still what the store holds.

        Raises:
            StoreError: It cannot be read.
        """
        if revision is None:
            revision = time.time_ns() // 1_000_000
        term = await store.begin_term() if fence is None else fence.term
        state = None if copy is None else await copy()
        if state is None:
            state = State(settings)
            with without_collections():
                for _ in state.reading(await load_converted(store, term)):
                    await asyncio.sleep(0)  # the lease is renewed meanwhile
        with without_collections():
            for _ in state.beginning(clock(), revision):
                await asyncio.sleep(0)
        return cls(state, store, clock, term, fence)

    @property
    def tables(self) -> Tables:
        """The state's tables, to read from."""
        return self.state.tables

    def spec(self, endpoint: str) -> EndpointSpec:
        """Tell what is desired of an endpoint.

        Raises:
            KeyError: There is no such endpoint.
        """
        return self.state.spec(endpoint)

    def patch(self, endpoint: str, touched: Touched) -> SpecPatch:
        """Return what is desired now of the parts of an endpoint that changed.

        Raises:
            KeyError: There is no such endpoint.
        """
        return self.state.patch(endpoint, touched)

    def copy_spec(self, endpoint: str) -> tuple[str, EndpointSpec] | None:
        """Tell where a container is being handed over to, and what is desired there; None if it is not."""
        return self.state.copy_spec(endpoint)

    def is_held(self, endpoint: str) -> bool:
        """Tell whether an endpoint is a container that is to run nowhere now (:meth:`State.is_held`)."""
        return self.state.is_held(endpoint)

    @property
    def is_full(self) -> bool:
        """Whether so many commands wait that :meth:`enqueue` would wait too."""
        return self._jobs.full()

    async def settled(self) -> None:
        """Wait until all that the tables show now is stored, or is taken back, which :attr:`reverts` tells.

        Raises:
            FencedError: This master leads no more; some of it may have been stored or not.
            EndedError: This master ends; the same holds.
        """
        await self._settled.wait()
        if self._end is not None:
            raise self._end

    async def check_store(self) -> None:
        """Tell whether the store works: what was last written was kept, and it is still where it was.

        Raises:
            StoreError: It does not.
        """
        if self._store_fault:
            raise StoreError(self._store_fault)
        await self._store.check()

    async def submit(self, command: Command) -> None:
        """Do a command; return when it is stored and all listeners were notified.

        Raises:
            RefusedError: It cannot be done; nothing changed.
            StoreError: It cannot be stored; nothing changed.
            EndedError: This master ends.
        """
        (outcome,) = await self.submit_all([command])
        if outcome is not None:
            raise outcome

    async def submit_all(self, commands: Sequence[Command]) -> list[Outcome]:
        """Do commands one after the other; one that is refused does not keep the others from being done.

        Returns:
            What became of each.
        """
        return await (await self.enqueue(commands))

    async def enqueue(self, commands: Sequence[Command]) -> asyncio.Future[list[Outcome]]:
        """Take commands, in the order of the calls; waits only while too many are waiting already.

        Returns:
            What becomes of each, once they are done.
        """
        job = _Job(commands, asyncio.get_running_loop().create_future())
        await self._jobs.put(job)
        if self._end is not None:
            self._refuse([], self._end)
        return job.done

    async def run(self) -> None:
        """Work until cancelled. However this ends, commands fail from then on.

        Raises:
            FencedError: This master leads no more; what it did last may have been stored or not.
        """
        jobs: list[_Job] = []
        try:
            while True:
                continues = self._is_unfinished
                if continues:
                    # Without this, work that writes nothing would leave the event loop to no other task.
                    await asyncio.sleep(0)
                jobs = [] if continues else [await self._jobs.get()]
                await self._work(jobs, takes_more=True, continues=continues)
                if self._store_fault and _has_tick(jobs):
                    await self._retry_store()
        except BaseException as error:
            # The servers wait for the commands of their peers while they close.
            self._end = error if isinstance(error, FencedError) else EndedError()
            self._refuse(jobs, self._end)
            raise

    async def _work(self, jobs: list[_Job], *, takes_more: bool = False, continues: bool = False) -> None:
        """Do jobs in one transaction of the store.

        Args:
            jobs: The jobs.
            takes_more: Whether to add those that wait.
            continues: Whether to do more of what was left over, after the jobs.
        """
        done: list[Changes] = []
        self._settled.clear()
        try:
            await self._apply_all(jobs, done, takes_more=takes_more, continues=continues)
            self._check_fence()
            await self._save(done)
            self._check_fence()
        except StoreError as error:
            if self._fence is not None and isinstance(error, FencedError):
                raise  # the state ends with the leadership; no request is answered from it
            self._revert(done)
            self._settled.set()
            if isinstance(error, SaveTooLargeError):
                self._max_work = max(1, self._max_work // 10)
            # The next tick does what was left over: a store that fails is not asked again at once.
            self._is_unfinished = False
            await self._stand_alone(jobs, error, was_alone=not continues)
            return
        except BaseException:
            self._revert(done)
            raise
        finally:
            self._settled.set()
        self._is_unfinished = any(changes.unfinished for changes in done)
        if continues or _has_tick(jobs):
            self._max_work = min(self.state.settings.max_work, self._max_work * 2)
        _touch_once(done)
        turn = _Turn()
        for changes in done:
            for listener in self.listeners:
                listener(changes)
            await turn.end_if_over()
        self._answer(jobs, None)

    def _check_fence(self) -> None:
        if self._fence is not None:
            self._fence.check()

    async def _apply_all(
        self, jobs: list[_Job], done: list[Changes], *, takes_more: bool, continues: bool
    ) -> None:
        turn = _Turn()
        for job in self._taken(jobs) if takes_more else jobs:
            job.outcomes = []
            for command in job.commands:
                # Between two turns, readers see what is not stored yet, as they do while it is being stored.
                await turn.end_if_over()
                job.outcomes.append(self._apply(command, done))
        if continues:
            await turn.end_if_over()
            self._apply(Continue(), done)

    def _taken(self, jobs: list[_Job]) -> Iterator[_Job]:
        """Iterate over jobs, and add those that wait, up to the size of a batch."""
        yield from jobs
        size = sum(len(job.commands) for job in jobs)
        while len(jobs) < MAX_BATCH and size < MAX_COMMANDS and not self._jobs.empty():
            jobs.append(self._jobs.get_nowait())
            size += len(jobs[-1].commands)
            yield jobs[-1]

    async def _save(self, done: list[Changes]) -> None:
        # Of a key that several commands wrote, only the newest record counts; nothing is encoded twice.
        keys = {key: table for changes in done for key, table in changes.written().items()}
        rows = [make_row(table, key) for (_, key), table in keys.items()]
        try:
            if rows:
                await self._store.save(rows, self._term)
                self._store_fault = ""
        except StoreError as error:
            self._store_fault = str(error)
            raise

    async def _retry_store(self) -> None:
        """Find out whether a store that refused a write can be written again: the next write may never come.

        Raises:
            FencedError: This master leads no more.
        """
        try:
            self._check_fence()
            await self._store.save([], self._term)
        except StoreError as error:
            if self._fence is not None and isinstance(error, FencedError):
                raise
            self._store_fault = str(error)
        else:
            self._store_fault = ""
            _log.info("the store can be written again")

    async def _stand_alone(self, jobs: list[_Job], error: StoreError, *, was_alone: bool) -> None:
        """Do jobs one by one after their common transaction failed: reports need no store.

        Args:
            jobs: The jobs.
            error: Of the transaction.
            was_alone: Whether it had nothing beside the jobs.
        """
        if not jobs or (len(jobs) == 1 and was_alone):
            _log.error("%s", error)
            self._answer(jobs, error)
            return
        for job in jobs:
            await self._work([job])

    def _apply(self, command: Command, done: list[Changes]) -> Outcome:
        try:
            done.append(self.state.apply(command, self._clock(), self._max_work))
        except RefusedError as error:
            return error
        except Exception as error:  # noqa: BLE001 - logged
            # A bug in one command must not stop the whole cloud; the command was not applied.
            _log.exception("could not apply %r", command)
            return MasterError(f"internal error: {error!r}")
        return None

    def _refuse(self, jobs: list[_Job], error: StoreError) -> None:
        """Let commands fail, and those that wait."""
        while not self._jobs.empty():
            jobs.append(self._jobs.get_nowait())
        for job in jobs:
            job.outcomes = [error for _ in job.commands]
        self._answer(jobs, error)

    def _revert(self, done: Sequence[Changes]) -> None:
        self.reverts += 1
        for changes in reversed(done):
            changes.revert()

    @staticmethod
    def _answer(jobs: list[_Job], error: StoreError | None) -> None:
        for job in jobs:
            if not job.done.done():
                job.done.set_result([outcome or error for outcome in job.outcomes])


async def load_converted(store: Store, term: int) -> Snapshot:
    """Read a store; one of the release before is converted in it, in one transaction.

    Args:
        store: The store.
        term: The term of it in which the caller writes.

    Raises:
        StoreError: It cannot be read or written, or holds a part of a state only.
    """
    snapshot = await store.load()
    check_finished(snapshot)
    rows = conversion(snapshot)
    if not rows:
        return snapshot
    _log.info("converting the store of an earlier release: %d records", len(rows))
    await store.save(rows, term)
    return await store.load()


def _has_tick(jobs: Sequence[_Job]) -> bool:
    return any(isinstance(command, Tick) for job in jobs for command in job.commands)


def _touch_once(done: Sequence[Changes]) -> None:
    """Keep each endpoint only in the last of several changes: its spec contains all of them."""
    later: dict[str, Touched] = {}
    for changes in reversed(done):
        once = {}
        for id_, touched in changes.touched.items():
            if id_ in later:
                later[id_].include(touched)
            else:
                once[id_] = later[id_] = touched
        changes.touched = once
