"""The fleet manager: the book of tasks, its journal, and the step that is taken again and again.

What changes the book is in the journal before it is answered or has an effect: requests and steps wait for
:meth:`FleetManager.commit`, which writes the events of all that wait in one transaction.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING, Any

from rce_fleet.exceptions import JournalError
from rce_fleet.journal.journal import EventQuery, event_fields
from rce_fleet.manager.change_locks import ChangeLocks
from rce_fleet.manager.clock import WallClock
from rce_fleet.manager.goals import NO_ANSWER, GoalKeeper
from rce_fleet.manager.hand_goals import HandGoals
from rce_fleet.manager.planner_link import carry_out
from rce_fleet.manager.planner_sync import FLEET, PlannerCall, PlannerSync, SetMode, SetZone
from rce_fleet.manager.robot_changes import RobotChanges
from rce_fleet.manager.statistics import BUCKET_S, BUCKETS, FleetStatistics, Minute
from rce_fleet.tasks.book import TaskBook
from rce_fleet.tasks.clamping import clamped
from rce_fleet.tasks.dispatch import Dispatcher, TaskRules, load_libraries
from rce_fleet.tasks.facts import FleetFacts
from rce_fleet.tasks.records import FleetEntry
from rce_fleet.tasks.task import Task

if TYPE_CHECKING:
    from collections.abc import Callable
    from logging import Logger

    from rce_fleet.journal.journal import Journal
    from rce_fleet.manager.planner_link import PlannerLink
    from rce_fleet.tasks.records import FleetEvent, PlannerRun, Zone

KEEP_ENDED = 10_000
"""So many tasks that have ended are kept; older ones are only in the history."""
KEEP_EVENTS = 200_000
"""So many events are kept in the journal."""
_TRIM_EVERY = 10_000
_AT_ONCE = 100
"""So many events are published in one go."""
LEAD_S = 60.0
"""People are warned if the journal is so much ahead of the machine's clock, seconds."""
CLOCK_STEP_S = 2.0
"""A smaller step of the clock is one as time servers make it, seconds."""


class FleetManager:
    """What people and programs asked for, and what becomes of it.

    Args:
        journal: Where everything is kept.
        planner: The planner's services.
        rules: The rules.
        log: For what people should know.
        publish: Called with events once they are in the journal.
        clock: Seconds since 1970.

    Attributes:
        book: The tasks.
        facts: What is known of the robots.
        goals: The goals that were sent.
        hand_goals: The goals that people set.
        changes: Lets requests that change the same thing at the planner follow each other.
        robot_changes: Which robots changed since a page asked last.
        written: Number of the last event that is in the journal.
    """

    def __init__(
        self,
        journal: Journal,
        planner: PlannerLink,
        rules: TaskRules,
        log: Logger,
        *,
        publish: Callable[[list[dict[str, Any]]], None] = lambda _events: None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._journal = journal
        self._planner = planner
        self._rules = rules
        self._log = log
        self._publish = publish
        self._thread = ThreadPoolExecutor(1, "journal")
        self._pending: list[FleetEvent] = []
        self._current: asyncio.Future[None] | None = None
        """Done when the batch that is being written is on the disk."""
        self._next: asyncio.Future[None] | None = None
        """The same of the batch after that, to which events are added meanwhile."""
        self._writer: asyncio.Task[None] | None = None
        self._failure = ""
        self._is_loaded = False
        """Whether the libraries that choose tasks were loaded."""
        self._is_stale = False
        """Whether the book may have what the journal has not, because that could not be read."""
        self.facts = FleetFacts()
        self.goals = GoalKeeper()
        self.changes = ChangeLocks(lambda: self._failure)
        self._load()
        self._sync = PlannerSync(self.book, self.facts)
        self.hand_goals = HandGoals(self.book, self.facts, self.goals)
        last = journal.events(EventQuery(after=self.book.number - 1, limit=1)) if self.book.number else []
        self._wall = WallClock(last[0]["time"] if last else 0.0)
        self._has_warned_of_lead = False
        self.clock = clock or self._wall
        self._follow_lead()
        self.robot_changes = RobotChanges(int(1000 * self.clock()))
        self.statistics = FleetStatistics(self.clock(), (Minute(*row) for row in journal.minutes()))

    def _load(self) -> None:
        """Make the book from the journal."""
        book = TaskBook()
        records, book.number = self._journal.load()
        book.last_task = self._journal.last_task
        for record in sorted(records, key=lambda each: each.number if isinstance(each, Task) else 0):
            book.put_record(clamped(record))
        book.grid = self.facts.grid
        self.book, self.written = book, book.number
        self.dispatcher = Dispatcher(book, self._rules)

    def _reload(self) -> None:
        """Make the book from the journal again; if it cannot be read, that is tried again later."""
        try:
            self._load()
        except JournalError as error:
            self._log.error("%s", error)
            self._is_stale = True
            return
        self._is_stale = False
        self._sync.take_book(self.book)
        self.hand_goals.take_book(self.book)

    # Steps

    async def step(self) -> None:
        """Take over what the robots did, and send them on. To be called several times a second."""
        await self._prepare_step()
        if self._failure:
            await self._try_journal()
            return
        now = self.clock()
        self._follow_clock(now)
        self.book.grid = self.facts.grid or self.book.grid
        self._sync.adopt(now)
        if self.facts.is_live:
            self.hand_goals.adopt(self.dispatcher.goals(), now)
        if not await self._dispatch(now):
            return
        ended = self.statistics.update(now, self.facts, self.book)
        try:
            await self.commit()
            if ended is not None:
                await self._in_thread(
                    *(self._journal.put_minute, ended.began, ended.busy, ended.all, now - BUCKETS * BUCKET_S)
                )
        except JournalError:
            return
        await self.tell_planner()
        await self._note_confirmed()
        if self.facts.is_live:
            await self._send_goals(now)

    async def _send_goals(self, now: float) -> None:
        """Send the planner the goals that it shall have; one that falls silent gets the rest later."""
        wanted = self.hand_goals.wanted(self.dispatcher.goals())
        for robot, cell in self.goals.to_send(self.facts, wanted, now):
            if not self.goals.is_newest(robot, cell):
                continue
            refusal = await self._planner.set_goal(robot, cell) if self.facts.is_live else NO_ANSWER
            if refusal:
                self.goals.refused(robot)

    async def _prepare_step(self) -> None:
        """Load and measure what the step needs; requests are answered meanwhile."""
        if self.book.open_count and not self._is_loaded:
            self._is_loaded = True
            await asyncio.to_thread(load_libraries)
        is_behind = True
        while is_behind:
            is_behind = self.dispatcher.measure(self.facts)
            await asyncio.sleep(0)

    async def _dispatch(self, now: float) -> bool:
        """Decide what the robots do; requests are answered between two parts.

        Returns:
            Whether that was done; False: the journal failed meanwhile, and the book was made from it again.
        """
        book = self.book
        for _ in self.dispatcher.parts(now, self.facts):
            await asyncio.sleep(0)
            if self._failure or self.book is not book:
                return False
        return True

    def _follow_lead(self) -> None:
        """Have deadlines and starts follow the machine's clock where that is behind the fleet's time."""
        lead = self.book.lead = self._wall.lead if self.clock is self._wall else 0.0
        if lead > LEAD_S and not self._has_warned_of_lead:
            self._log.warning(
                "the fleet's time is %.0f s ahead of this machine's clock, which was set back, or the journal"
                " is of a machine that was ahead: deadlines and starts follow the clock, and times of events"
                " run slower until both agree; set the machine's clock if it is wrong",
                lead,
            )
        self._has_warned_of_lead = lead > LEAD_S

    def _follow_clock(self, now: float) -> None:
        """Count no step of the clock as time in which robots did something, or did not."""
        self._follow_lead()
        step, self._wall.stepped = self._wall.stepped, 0.0
        if step > CLOCK_STEP_S and self.clock is self._wall:
            self._log.warning("the clock of this machine was set %.0f s forward", step)
            self.facts.skip(step, now)
            self.statistics.skip(step)

    def planner_began(self, run: PlannerRun) -> None:
        """Begin with a planner that was started, or is heard for the first time.

        It gets modes, zones, blocked cells and goals with the next step.

        Args:
            run: The planner.
        """
        now, known = self.clock(), self.book.planner
        is_other_floor = run.has_other_floor(known)
        if is_other_floor:
            self.dispatcher.leave_floor()
        is_same = run.started == known.started
        self.hand_goals.begin(now, is_same=is_same, is_other_floor=is_other_floor)
        remark = self._sync.begin(run, now)
        if remark:
            self._log.warning("%s", remark)

    async def tell_planner(self) -> None:
        """Send modes, zones and blocked cells that the planner does not have yet."""
        for call in self._sync.calls(self.clock()):
            if not self.facts.is_live:
                break
            refusal = await self._tell(call)
            if refusal:
                self._log.warning("the planner refused %s: %s", call, refusal)
                if isinstance(call, SetZone) and call.zone and not refusal.startswith(NO_ANSWER):
                    before = self.facts.zones.get(call.id)
                    self._sync.undo_zone(call.zone, before, self.clock(), refusal)

    async def tell(self, call: PlannerCall) -> str:
        """Send what a request changed, which is in the journal, to the planner at once.

        Returns:
            Why the planner refused; empty: it did not, or gets the change when it is heard again.
        """
        return await self._tell(call) if self.facts.is_live else ""

    async def set_zone(self, zone: Zone, before: Zone | None) -> str:
        """Send a zone of a request, which is in the journal, to the planner at once.

        Args:
            zone: The zone.
            before: What it replaces; None: nothing.

        Returns:
            Why the planner refused, so that the zones are as they were before; empty: it did not, or gets the
            zone when it is heard again.

        Raises:
            JournalError: The journal cannot be written.
        """
        refusal = await self.tell(SetZone(zone.id, zone))
        if not refusal or refusal.startswith(NO_ANSWER):
            return ""
        if self._sync.undo_zone(zone, before, self.clock(), refusal):
            await self.commit()
        return refusal

    async def set_fleet_mode(self, mode: str, reason: str, user: str) -> str:
        """Keep the fleet's mode in the journal, then send it to the planner at once.

        Args:
            mode: ``automatic`` or ``paused``.
            reason: Why, for people.
            user: Who asks.

        Returns:
            Why the planner refused, so that the mode is as it was before; empty: it did not, or gets the mode
            when it is heard again.

        Raises:
            JournalError: The journal cannot be written.
        """
        async with self.changes.hold("mode"):
            before = self.book.fleet
            changed = FleetEntry(mode, reason, user, before.revision + 1, unsent=True)
            text = f"the fleet is {mode}" + (f": {reason}" if reason else "")
            self.book.emit(changed, mode, self.clock(), user=user, text=text)
            await self.commit()
            refusal = await self.tell(SetMode(FLEET, mode, reason, user))
            if refusal and self.book.fleet == changed:
                back = replace(before, revision=changed.revision + 1)
                text = f"the fleet stays {before.mode}: {refusal}"
                self.book.emit(back, "refused", self.clock(), text=text)
                await self.commit()
            return refusal

    async def set_goal(self, robot: str, cell: int | None, user: str) -> str:
        """Keep a robot's goal in the journal, then send it to the planner.

        Args:
            robot: Its name.
            cell: The goal; None: stop and stay.
            user: Who asks.

        Returns:
            Why the planner refused, so that the goal is as it was before; empty: it did not, or gets the goal
            when it is heard again.

        Raises:
            TaskRefusedError: The robot cannot have a goal of a person now.
            JournalError: The journal cannot be written.
        """
        async with self.changes.hold("goal", robot):
            before = self.book.goals.get(robot)
            entry = self.hand_goals.request(robot, cell, self.clock(), user)
            with self.hand_goals.asking(entry, self.clock()):
                await self.commit()
                if not self.facts.is_live:
                    return ""
                refusal = await self._planner.set_goal(robot, cell)
                if not refusal or not self.hand_goals.undo(entry, before, self.clock(), refusal):
                    return refusal
            await self.commit()
            return refusal

    async def _note_confirmed(self) -> None:
        """Keep in the journal what the planner confirmed: it is not sent again after a restart."""
        if self._next is not None or self._current is not None:
            return  # an older record must not follow one that is being written
        records = [*self._sync.confirmed(), *self.hand_goals.confirmed()]
        for record in records:
            self.book.put_record(record)
        if records:
            try:
                await self._in_thread(self._journal.put, records)
            except JournalError as error:
                self._log.warning(
                    "%s; modes, zones, cells and goals may be sent again after a restart", error
                )

    async def _tell(self, call: PlannerCall) -> str:
        self._sync.took(call, self.clock(), refused=True)  # no step sends it once more meanwhile
        refusal = await carry_out(self._planner, call, self.clock())
        self._sync.took(call, self.clock(), refused=bool(refusal))
        return refusal

    # Journal

    async def commit(self) -> None:
        """Write the book's new events; return when they are on the disk.

        Raises:
            JournalError: They could not be written. The book is then as it was before them.
        """
        events = self.book.take_events()
        if events:
            self._pending += events
            if self._next is None:
                self._next = asyncio.get_running_loop().create_future()
        if self._next is not None and (self._writer is None or self._writer.done()):
            self._writer = asyncio.create_task(self._write())
        waiting = self._next or self._current
        if waiting is not None:
            await asyncio.shield(waiting)

    async def _write(self) -> None:
        """Write what is pending, and what becomes pending meanwhile, batch by batch."""
        while self._next is not None:
            batch, self._pending = self._pending, []
            waiting, self._next = self._next, None
            self._current = waiting
            try:
                await self._in_thread(self._journal.append, batch, self._forget_old())
            except JournalError as error:
                self._roll_back(error)
                return
            except Exception as error:  # noqa: BLE001 - those who wait for the batch must not wait for good
                self._roll_back(JournalError(f"the journal cannot be written: {error!r}"))
                return
            self._current = None
            self.written = batch[-1].number
            waiting.set_result(None)
            try:
                await self._after_write(batch)
            except Exception as error:  # noqa: BLE001 - the next batch must be written all the same
                self._log.error("after events %d .. %d: %s", batch[0].number, batch[-1].number, error)

    async def _after_write(self, batch: list[FleetEvent]) -> None:
        """Publish events that are in the journal, and forget old ones from time to time."""
        for begin in range(0, len(batch), _AT_ONCE):
            self._publish(event_fields(batch[begin : begin + _AT_ONCE]))
            await asyncio.sleep(0)  # Requests are answered meanwhile.
        if batch[-1].number // _TRIM_EVERY != (batch[0].number - 1) // _TRIM_EVERY:
            await self._in_thread(self._journal.forget_events, batch[-1].number - KEEP_EVENTS)

    def _roll_back(self, error: JournalError) -> None:
        """Go back to what the journal has: nothing was accepted that is not in it."""
        self._log.error("%s; requests that change something are refused until it can be written", error)
        self._failure = str(error)
        for future in (self._current, self._next):
            if future is not None and not future.done():
                future.set_exception(error)
                future.exception()  # those who wait get it; it is not lost if none of them does
        self._current = self._next = None
        self._pending.clear()
        self._reload()

    async def _try_journal(self) -> None:
        """Look whether the journal can be written again."""
        if self._is_stale:
            self._reload()
        if self._is_stale:
            await asyncio.sleep(1.0)
            return
        places = self.book.places
        self.book.emit(places, "checked", self.clock(), text="the journal can be written again")
        batch = self.book.take_events()
        try:
            await self._in_thread(self._journal.append, batch)
        except JournalError:
            self._reload()
            await asyncio.sleep(1.0)
            return
        self._failure = ""
        self.written = batch[-1].number
        self._publish(event_fields(batch))
        self._log.info("the journal can be written again")

    @property
    def failure(self) -> str:
        """Why nothing can be accepted now; empty: it can."""
        return self._failure

    @property
    def is_stale(self) -> bool:
        """Whether nothing can be told of tasks: the book may have what could not be written."""
        return self._is_stale

    @property
    def journal_id(self) -> str:
        """Which journal numbers the events."""
        return self._journal.id

    async def events(self, query: EventQuery) -> list[dict[str, Any]]:
        """Return events of the journal."""
        found: list[dict[str, Any]] = await self._in_thread(self._journal.events, query)
        return found

    async def close(self) -> None:
        """Write what is left and close the journal."""
        if self._writer is not None:
            await asyncio.wait([self._writer])
        await self._in_thread(self._journal.close)
        self._thread.shutdown()

    def known_since(self) -> float:
        """Return from when on all tasks that have ended are known, seconds since 1970; ``-inf``: all are."""
        book = self.book
        if book.last_task <= len(book.tasks):
            return -inf
        ended = sorted(task.changed_at for task in book.tasks.values() if task.has_ended)
        return ended[-KEEP_ENDED] if 0 < KEEP_ENDED <= len(ended) else ended[0] if ended else self.clock()

    def _forget_old(self) -> list[tuple[str, str]]:
        """Forget the oldest tasks that have ended, if there are too many; not those that others wait for."""
        if len(self.book.tasks) - self.book.open_count <= KEEP_ENDED + KEEP_ENDED // 10:
            return []
        awaited = {name for task in self.book.open_tasks() for name in task.order.after}
        ended = [
            task
            for task in self.book.tasks.values()
            if task.has_ended and task.recurs_at is None and task.id not in awaited
        ]
        old = sorted(ended, key=lambda task: task.changed_at)[: max(0, len(ended) - KEEP_ENDED)]
        for task in old:
            self.book.forget(task.number)
        return [("task", task.id) for task in old]

    async def _in_thread(self, work: Callable[..., Any], *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work, *arguments)
