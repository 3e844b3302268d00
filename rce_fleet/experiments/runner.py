"""Runs experiments: the link is measured first, then each set-up again and again; raw data go to a table.

A run that is interrupted leaves no rows that count: its row ``done`` is written last.
"""

from __future__ import annotations

import asyncio
import time
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, NamedTuple

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.bench import CLIENT, SERVER, Bench
from rce_fleet.experiments.experiment import NOT_ANY, Experiment, Options, Trial
from rce_fleet.experiments.results import Condition, Row, read_rows, write_rows
from rce_fleet.experiments.schedule import WARM_UP, Run, remaining, schedule
from rce_fleet.experiments.systems.software import software_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

TABLE = "results.csv"
DONE = "done"
"""Metric of the last row of a run: how long it took, seconds."""
PREPARED = "prepared"
SAMPLE_S = 60.0
"""Planned time of what must be done until its pace counts for the rest."""
LINK = "link"
LINK_DELAYS_S = (0.005, 0.0, 0.02)
LINK_UNITS = {"round_trip": "s", "round_trip_p99": "s", "lost": "", "rate": "bit/s"}
LINK_SECONDS = 4.0
TRIES = 2
"""How often a run is tried before its error ends the experiment."""


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

    def options_of(self, experiment: Experiment) -> Options:
        """Return how an experiment is done: with the software that has its programs."""
        return experiment.possible(self.options)

    def left_out(self) -> list[str]:
        """Return a line for each experiment that is done without some software, and why.

        Raises:
            ExperimentError: No experiment can be done with the software.
        """
        lines = [
            f"{one.name} is not done with the software {software}: it has no program {', '.join(lacking)}"
            for one in self.experiments
            for software in self.options.software
            if (lacking := one.lacking(software))
        ]
        if lines and not any(self.options_of(one).software for one in self.experiments):
            raise ExperimentError("; ".join(lines))
        return lines

    def works(self, experiment: Experiment, rows: list[Row]) -> list[Work]:
        """Return the runs of an experiment that are still to be done."""
        setups = experiment.setups(self.options_of(experiment))
        planned = schedule(setups, self.runs, self.seed, warm_up=not self.options.quick)
        most = {condition: experiment.most_runs(condition) for condition in dict(planned)}
        planned = [run for run in planned if run.number <= (most[run.condition] or run.number)]
        done = {Run(row.condition, row.run) for row in rows if row.metric == DONE}
        return [Work(experiment, run) for run in remaining(planned, done)]

    def seconds(self, experiment: Experiment, rows: list[Row]) -> float:
        """Return about how long an experiment still takes."""
        works = self.works(experiment, rows)
        if not works:
            return 0.0
        runs = sum(self.run_seconds(work) for work in works)
        return runs + experiment.preparation_seconds(self.options_of(experiment))

    def run_seconds(self, work: Work) -> float:
        """Return about how long a run takes."""
        seconds = work.experiment.seconds
        if work.run.number == WARM_UP:
            seconds = work.experiment.warm_up_seconds
        return seconds(work.run.condition, self.options_of(work.experiment))


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
    """

    def __init__(self, plan: Plan, folder: Path, say: Callable[[str], None]) -> None:
        self._plan = plan
        self._table = folder / TABLE
        self._say = say

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
        """
        self._drop_unfinished()
        await self._prepare_software()
        await self._measure_link()
        pace = Pace(sum(self._plan.seconds(one, self.rows()) for one in self._plan.experiments))
        for experiment in self._plan.experiments:
            works = self._plan.works(experiment, self.rows())
            if not works:
                self._say(f"{experiment.name}: all runs are done")
                continue
            prepared = await self._prepare(experiment)
            pace.done(experiment.preparation_seconds(self._plan.options_of(experiment)))
            for number, work in enumerate(works, 1):
                left = pace.left() / 60
                self._say(f"{_named(work)} ({number} of {len(works)}; about {left:.0f} min left)")
                await self._do(work, prepared)
                pace.done(self._plan.run_seconds(work))

    async def _do(self, work: Work, prepared: dict[str, float]) -> None:
        run = work.run
        seed = hash_of(self._plan.seed, run)
        options = self._plan.options_of(work.experiment)
        trial = Trial(run.condition, options, seed, run.number == WARM_UP, prepared)
        began = time.monotonic()
        for attempt in range(1, TRIES + 1):
            try:
                measured = await work.experiment.measure(trial)
                break
            except ExperimentError as error:
                if attempt == TRIES:
                    raise ExperimentError(f"{_named(work)}: {error}") from error
                self._say(f"{_named(work)} is tried again: {error}")
        if run.number == WARM_UP:
            return
        rows = [Row(one.condition, run.number, *one.value) for one in measured]
        took = Row(run.condition, run.number, DONE, time.monotonic() - began, "s")
        attempts = Row(run.condition, run.number, "tries", float(attempt), "")
        await asyncio.to_thread(write_rows, self._table, [*rows, attempts, took])

    async def _prepare_software(self) -> None:
        """Have the software make what it needs, before anything is measured."""
        for name in self._plan.options.software:
            await asyncio.to_thread(software_of(name).prepare, self._say)

    async def _prepare(self, experiment: Experiment) -> dict[str, float]:
        condition = Condition.of(experiment.name, NOT_ANY, NOT_ANY, part=PREPARED)
        found = {row.metric: row.value for row in self.rows() if row.condition == condition}
        options = self._plan.options_of(experiment)
        if not found and experiment.preparation_seconds(options):
            self._say(f"{experiment.name}: preparing")
            values = await experiment.prepare(options, self._plan.seed)
            write_rows(self._table, [Row(condition, 1, *value) for value in values])
            found = {value.metric: value.value for value in values}
        return found

    async def _measure_link(self) -> None:
        """Measure the shaped links."""
        known = {row.condition for row in self.rows()}
        for delay in LINK_DELAYS_S[: 1 if self._plan.options.quick else None]:
            condition = Condition.of(LINK, NOT_ANY, NOT_ANY, delay=round(1000 * delay))
            if condition in known:
                continue
            async with Bench(delay=delay, seed=self._plan.seed) as bench:
                figures = await bench.probe(CLIENT, SERVER)
            self._say(
                f"link with {1000 * delay:g} ms of delay: round trip {1000 * figures.round_trip_s:.1f} ms "
                f"(99 % below {1000 * figures.round_trip_p99_s:.1f}), "
                f"{figures.rate / 1e6:.1f} Mbit/s, {100 * figures.lost:.1f} % lost"
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
