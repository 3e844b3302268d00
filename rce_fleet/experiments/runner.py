"""Runs experiments: the link is measured first, then all set-ups, round by round; raw data go to a table.

A run that is interrupted leaves no rows that count: its row ``done`` is written last.
"""

from __future__ import annotations

import asyncio
import time
import zlib
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.bench import CLIENT, DELAY_S, RATE, SERVER, Bench
from rce_fleet.experiments.clock_watch import ClockWatch
from rce_fleet.experiments.experiment import Experiment, Link, Options, Trial
from rce_fleet.experiments.machine_work import processor_time, work_condition
from rce_fleet.experiments.results import (
    DONE,
    LINK,
    NOT_ANY,
    TABLE,
    TRIED,
    WORK,
    Condition,
    Row,
    error_text,
    read_rows,
    write_rows,
)
from rce_fleet.experiments.schedule import WARM_UP, Run, remaining, schedule
from rce_fleet.experiments.systems.base import together
from rce_fleet.experiments.systems.software import software_of

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator
    from pathlib import Path

T = TypeVar("T")

PREPARED = "prepared"
SAMPLE_S = 60.0
"""Planned time of what must be done until its pace counts for the rest."""
USUAL_LINKS = tuple(Link(RATE / 1e6, delay) for delay in (1000 * DELAY_S, 0.0, 20.0))
"""Links that are measured before all experiments; quickly, the first one only."""
LINK_UNITS = {"round_trip": "s", "round_trip_p99": "s", "lost": "", "rate": "bit/s", "rate_back": "bit/s"}
TRIES = 2
"""How often a run is tried before its error ends the experiment."""
QUICK_AT_ONCE = 3
"""Runs of a quick plan that are under way at once: most of a run is waiting for programs to start."""


class Work(NamedTuple):
    """A run that is to be done."""

    experiment: Experiment
    run: Run


@dataclass(slots=True)
class Plan:
    """What is to be done.

    Attributes:
        experiments: The experiments.
        options: How they are done.
        runs: Runs of each set-up that count.
        seed: Of the order, and of everything random.
    """

    experiments: list[Experiment]
    options: Options
    runs: int
    seed: int

    def at_once(self, experiment: Experiment) -> int:
        """Return how many runs of an experiment are done at the same time."""
        return QUICK_AT_ONCE if self.options.quick else experiment.at_once

    def links(self) -> list[Link]:
        """Return the links that are measured first: the usual ones, and those of the experiments."""
        if self.options.quick:
            return [USUAL_LINKS[0]]
        further = (link for one in self.experiments for link in one.links(self.options_of(one)))
        return list(dict.fromkeys((*USUAL_LINKS, *further)))

    def options_of(self, experiment: Experiment) -> Options:
        """Return how an experiment is done: with the software that has its programs."""
        return experiment.possible(self.options)

    def left_out(self) -> list[str]:
        """Return a line for each experiment that is done without some software, or not at all, and why.

        Raises:
            ExperimentError: No experiment can be done with the systems and the software.
        """
        lines = [
            f"{one.name} is not done with the software {software}: it has no program {', '.join(lacking)}"
            for one in self.experiments
            for software in self.options.software
            if (lacking := one.lacking(software))
        ]
        options = self.options
        lines += [
            f"{one.name} is not done: it has nothing to measure with the systems "
            f"{', '.join(options.systems)} and the software {', '.join(possible)}"
            for one in self.experiments
            if (possible := self.options_of(one).software) and not self._setups(one)
        ]
        if lines and not any(map(self._setups, self.experiments)):
            raise ExperimentError("; ".join(lines))
        return lines

    def _setups(self, experiment: Experiment) -> list[Condition]:
        return experiment.setups(self.options_of(experiment))

    def works(self, experiment: Experiment, rows: list[Row]) -> list[Work]:
        """Return the runs of an experiment that are still to be done."""
        planned = schedule(self._setups(experiment), self.runs, self.seed, warm_up=not self.options.quick)
        done = {Run(row.condition, row.run) for row in rows if row.metric == DONE}
        return [Work(experiment, run) for run in remaining(planned, done)]

    def seconds(self, experiment: Experiment, rows: list[Row]) -> float:
        """Return about how long an experiment still takes, seconds."""
        works = self.works(experiment, rows)
        if not works:
            return 0.0
        runs = sum(self.run_seconds(work) for work in works)
        return runs + experiment.preparation_seconds(self.options_of(experiment))

    def run_seconds(self, work: Work) -> float:
        """Return about by how long a run makes the plan longer, seconds."""
        seconds = work.experiment.seconds
        if work.run.number == WARM_UP:
            seconds = work.experiment.warm_up_seconds
        return seconds(work.run.condition, self.options_of(work.experiment)) / self.at_once(work.experiment)


class Pace:
    """How long the rest of a plan takes: as planned, at the pace of what was done, once that is enough.

    Args:
        planned: Seconds that all of it takes as planned.
        clock: Seconds that never go back.
    """

    def __init__(self, planned: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._left = planned
        self._done = 0.0
        self._clock = clock
        self._began = clock()

    def done(self, planned: float) -> None:
        """Note that something was done.

        Args:
            planned: Seconds that it takes as planned.
        """
        self._left = max(0.0, self._left - planned)
        self._done += planned

    def left(self) -> float:
        """Return about how many seconds the rest takes."""
        took = self._clock() - self._began
        return self._left * took / self._done if self._done >= SAMPLE_S else self._left


class Runner:
    """Does a plan.

    Args:
        plan: What is to be done.
        folder: For the raw data; rows that are there count as done.
        say: Called with each line of progress.
        wall: The clock whose stamps messages have, seconds since 1970.
    """

    def __init__(
        self,
        plan: Plan,
        folder: Path,
        say: Callable[[str], None],
        *,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._plan = plan
        self._wall = wall
        self._table = folder / TABLE
        self._say = say
        self._prepared: dict[str, dict[str, float]] = {}
        """What the preparations of experiments found, by their names."""
        self._preparing = asyncio.Lock()
        self._writing = asyncio.Lock()
        """Held while the rows of a run are written: they stay together."""
        self._worked: Counter[Condition] = Counter()
        """How often the time of the machine's work was taken in each round."""

    def rows(self) -> list[Row]:
        """Return the raw data so far.

        Raises:
            ExperimentError: The table cannot be read.
        """
        try:
            return read_rows(self._table)
        except FileNotFoundError:
            return []

    async def run(self) -> None:
        """Do everything that is not done yet.

        Raises:
            ExperimentError: Something cannot be done; what is done stays.
            OSError: The table cannot be read or written.
        """
        self._drop_unfinished()
        await self._prepare_software()
        await self._measure_link()
        rows = self.rows()
        self._worked.update(row.condition for row in rows if row.metric == WORK)
        pace = Pace(sum(self._plan.seconds(one, rows) for one in self._plan.experiments))
        by_lanes: dict[int, list[tuple[Work, str]]] = {}
        for experiment in self._plan.experiments:
            works = self._plan.works(experiment, rows)
            if not works:
                self._say(f"{experiment.name}: all runs are done")
            placed = ((work, f"{number} of {len(works)}") for number, work in enumerate(works, 1))
            by_lanes.setdefault(self._plan.at_once(experiment), []).extend(placed)
        for at_once, all_works in sorted(by_lanes.items()):
            all_works.sort(key=self._order)
            await self._do_together(all_works, at_once, pace)

    def _order(self, placed: tuple[Work, str]) -> float:
        """Return the place of a run among those of all experiments.

        Round by round: what changes slowly, such as the load of a computer's neighbours, then meets all
        experiments, and shows in the intervals. Quickly, the longest first: none is left over at the end.
        """
        work, _ = placed
        return -self._plan.run_seconds(work) if self._plan.options.quick else work.run.number

    async def _do_together(self, works: list[tuple[Work, str]], at_once: int, pace: Pace) -> None:
        """Do runs, some of them at the same time."""
        waiting = deque(works)
        await together(*(self._do_all(waiting, pace) for _ in range(at_once)))

    async def _do_all(self, waiting: deque[tuple[Work, str]], pace: Pace) -> None:
        """Do runs until none is waiting.

        Args:
            waiting: The runs, each with its place among those of its experiment.
            pace: Is told of each run.
        """
        while waiting:
            work, place = waiting.popleft()
            prepared = await self._prepare(work.experiment, pace)
            self._say(f"{_named(work)} ({place}; about {pace.left() / 60:.0f} min left)")
            if self._plan.at_once(work.experiment) == 1 and work.run.number != WARM_UP:
                await self._measure_machine(work.run.number)
            await self._do(work, prepared)
            pace.done(self._plan.run_seconds(work))

    async def _do(self, work: Work, prepared: dict[str, float]) -> None:
        run = work.run
        seed = hash_of(self._plan.seed, run)
        options = self._plan.options_of(work.experiment)
        trial = Trial(run.condition, options, seed, run.number == WARM_UP, prepared)
        began = time.monotonic()
        measured, tries = await self._tried(_named(work), lambda: work.experiment.measure(trial))
        if run.number == WARM_UP:
            return
        rows = [Row(one.condition, run.number, *one.value) for one in measured]
        took = Row(run.condition, run.number, DONE, time.monotonic() - began, "s")
        attempts = Row(run.condition, run.number, TRIED, float(tries), "")
        async with self._writing:
            await asyncio.to_thread(write_rows, self._table, [*rows, attempts, took])

    async def _tried(self, name: str, measure: Callable[[], Awaitable[T]]) -> tuple[T, int]:
        """Return what was measured, and how often that was tried.

        Args:
            name: What is measured.
            measure: Measures it.

        Raises:
            ExperimentError: The last attempt failed too.
        """
        attempt = 0
        while True:
            attempt += 1
            watch = ClockWatch(self._wall)
            try:
                found = await measure()
                watch.check()
            except (ExperimentError, OSError) as error:
                text = error_text(error)
                if attempt == TRIES:
                    raise ExperimentError(f"{name}: {text}") from error
                self._say(f"{name} is tried again: {text}")
            else:
                return found, attempt

    async def _prepare_software(self) -> None:
        """Have the software make what it needs, before anything is measured."""
        for name in self._plan.options.software:
            await asyncio.to_thread(software_of(name).prepare, self._say)

    async def _prepare(self, experiment: Experiment, pace: Pace) -> dict[str, float]:
        """Return what an experiment's preparation finds, which is done once."""
        async with self._preparing:
            if experiment.name not in self._prepared:
                self._prepared[experiment.name] = await self._find(experiment)
                pace.done(experiment.preparation_seconds(self._plan.options_of(experiment)))
        return self._prepared[experiment.name]

    async def _find(self, experiment: Experiment) -> dict[str, float]:
        options = self._plan.options_of(experiment)
        condition = Condition.of(experiment.name, NOT_ANY, options.software[0], part=PREPARED)
        found = {row.metric: row.value for row in self.rows() if row.condition == condition}
        if not found and experiment.preparation_seconds(options):
            self._say(f"{experiment.name}: preparing")
            values, _ = await self._tried(
                f"{experiment.name}: preparation", lambda: experiment.prepare(options, self._plan.seed)
            )
            write_rows(self._table, [Row(condition, 1, *value) for value in values])
            found = {value.metric: value.value for value in values}
        return found

    async def _measure_machine(self, number: int) -> None:
        """Take the time of the machine's work before a run; not while other runs are under way.

        Args:
            number: Of the round.
        """
        condition = work_condition(number)
        seconds = await asyncio.to_thread(processor_time)
        self._worked[condition] += 1
        row = Row(condition, self._worked[condition], WORK, seconds, "s")
        await asyncio.to_thread(write_rows, self._table, [row])

    async def _measure_link(self) -> None:
        """Measure the shaped links, in both directions."""
        known = {row.condition for row in self.rows()}
        for link in self._plan.links():
            condition = link_condition(link)
            if condition in known:
                continue
            async with Bench(delay=link.delay / 1000, rate=1e6 * link.rate, seed=self._plan.seed) as bench:
                figures = await bench.probe(CLIENT, SERVER)
            self._say(
                f"link of {link.rate:g} Mbit/s with {link.delay:g} ms of delay: round trip "
                f"{1000 * figures.round_trip_s:.1f} ms (99 % below {1000 * figures.round_trip_p99_s:.1f}), "
                f"{figures.rate / 1e6:.3g} Mbit/s to machine 1, {figures.rate_back / 1e6:.3g} Mbit/s back, "
                f"{100 * figures.lost:.1f} % lost"
            )
            values = {name.removesuffix("_s"): value for name, value in asdict(figures).items()}
            write_rows(
                self._table,
                [Row(condition, 1, name, values[name], unit) for name, unit in LINK_UNITS.items()],
            )

    def _drop_unfinished(self) -> None:
        """Leave out the rows of a run that was interrupted, and a line that was not completely written."""
        rows = self.rows()
        kept: list[Row] = []
        for rows_of_run in _by_run(rows):
            if rows_of_run[-1].metric == DONE or rows_of_run[0].condition.system == NOT_ANY:
                kept += rows_of_run
        if kept != rows or self._table.exists():
            new = self._table.with_suffix(".new")
            new.unlink(missing_ok=True)
            write_rows(new, kept)
            new.replace(self._table)


def link_condition(link: Link) -> Condition:
    """Return the condition of what is measured of a link itself."""
    return Condition.of(LINK, NOT_ANY, NOT_ANY, **link.factors)


def hash_of(seed: int, run: Run) -> int:
    """Return the seed of a run: the same for the same run of the same plan, and different for others."""
    return zlib.crc32(f"{seed} {run}".encode())


def _by_run(rows: Sequence[Row]) -> Iterator[list[Row]]:
    """Yield the rows of each run: they end with ``done``; those that belong to no run come alone."""
    part: list[Row] = []
    for row in rows:
        if row.condition.system == NOT_ANY:
            yield [row]
            continue
        part.append(row)
        if row.metric == DONE:
            yield part
            part = []
    if part:
        yield part


def _named(work: Work) -> str:
    setup, number = work.run
    factors = "".join(f" {name}={value}" for name, value in setup.factors)
    kind = "warm-up" if number == WARM_UP else f"run {number}"
    return f"{setup.experiment}: {setup.system} {setup.software}{factors}, {kind}"
