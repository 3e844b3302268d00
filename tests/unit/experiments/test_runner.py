"""The runner: what is done, tried again, resumed; with an experiment that measures without machines."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Self

import pytest

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments import runner as module
from rce_fleet.experiments.bench import CLIENT, SERVER
from rce_fleet.experiments.catalogue import EXPERIMENTS
from rce_fleet.experiments.command import QUICK_ROBOTS, QUICK_SECONDS
from rce_fleet.experiments.experiment import Experiment, Link, Measured, Options, Trial
from rce_fleet.experiments.folders import RUNS as RUNS_OF_ALL
from rce_fleet.experiments.machine_work import processor_time, work_condition
from rce_fleet.experiments.machines import LinkFigures
from rce_fleet.experiments.measures import Value
from rce_fleet.experiments.results import (
    DONE,
    TABLE,
    TRIED,
    WORK,
    Condition,
    Row,
    by_condition,
    read_rows,
    write_rows,
)
from rce_fleet.experiments.runner import (
    SAMPLE_S,
    USUAL_LINKS,
    Pace,
    Plan,
    Runner,
    link_condition,
)
from rce_fleet.experiments.systems.software import USUAL

OPTIONS = Options(systems=("single_master", "cloud"), software=("rce",))
QUICK = replace(OPTIONS, quick=True)
RUNS = 2


class Dice(Experiment):
    """Throws dice instead of starting machines."""

    name = "dice"
    title = "dice"

    def __init__(self) -> None:
        self.trials: list[Trial] = []
        self.prepared = 0
        self.fails = 0

    def setups(self, options: Options) -> list[Condition]:
        return self.each(options)

    def seconds(self, setup: Condition, options: Options) -> float:
        del setup, options
        return 10.0

    def preparation_seconds(self, options: Options) -> float:
        del options
        return 5.0

    async def prepare(self, options: Options, seed: int) -> list[Value]:
        del options, seed
        self.prepared += 1
        return [Value("sides", 6.0, "count")]

    async def measure(self, trial: Trial) -> list[Measured]:
        self.trials.append(trial)
        if self.fails:
            self.fails -= 1
            raise ExperimentError("the dice fell off the table")
        assert trial.prepared == {"sides": 6.0}
        return trial.measured([Value("eyes", float(1 + trial.seed % 6), "")], colour="red")


def runner(
    folder: Path,
    dice: Dice,
    said: list[str],
    *,
    runs: int = RUNS,
    seed: int = 1,
    options: Options = OPTIONS,
    wall: Callable[[], float] = time.time,
) -> Runner:
    if not (folder / TABLE).exists():
        write_link(folder)
    return Runner(Plan([dice], options, runs, seed), folder, said.append, wall=wall)


def write_link(folder: Path) -> None:
    """Write what was measured of the links before."""
    write_rows(folder / TABLE, [Row(link_condition(one), 1, "rate", 1.0, "bit/s") for one in USUAL_LINKS])


class Dialled(Dice):
    """Dice that are thrown over links, one of which is a usual one."""

    def links(self, options: Options) -> list[Link]:
        return [USUAL_LINKS[0], Link(0.5, 100)] if options.software else []


class Wire:
    """Machines whose link has the figures that were asked for, but is slower back."""

    def __init__(self, *, delay: float, rate: float, seed: int) -> None:
        assert seed == 1
        self._figures = LinkFigures(2 * delay, 3 * delay, 0.0, rate, rate / 2)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None: ...

    async def probe(self, machine: str, other: str) -> LinkFigures:
        assert (machine, other) == (CLIENT, SERVER)
        return self._figures


@pytest.mark.parametrize("quick", [False, True])
async def test_links_of_experiments_are_measured_both_ways(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, quick: bool
) -> None:
    """Each once, also those that only one experiment needs; quickly, only that of all."""
    monkeypatch.setattr(module, "Bench", Wire)
    said: list[str] = []
    write_rows(tmp_path / TABLE, [])
    await runner(tmp_path, Dialled(), said, options=QUICK if quick else OPTIONS).run()
    rows = read_rows(tmp_path / TABLE)
    expected = [USUAL_LINKS[0]] if quick else [*USUAL_LINKS, Link(0.5, 100)]
    for metric, share in (("rate", 1e6), ("rate_back", 0.5e6)):
        found = by_condition(rows, metric)
        assert found == {link_condition(link): [share * link.rate] for link in expected}
    assert quick or (
        "link of 0.5 Mbit/s with 100 ms of delay: round trip 200.0 ms (99 % below 300.0), 0.5 Mbit/s to "
        "machine 1, 0.25 Mbit/s back, 0.0 % lost" in said
    )


async def test_each_setup_is_warmed_up_and_run(tmp_path: Path) -> None:
    dice, said = Dice(), list[str]()
    await runner(tmp_path, dice, said).run()
    assert [trial.is_warm_up for trial in dice.trials] == [True, True, False, False, False, False]
    assert len({trial.seed for trial in dice.trials}) == len(dice.trials)
    rows = read_rows(tmp_path / TABLE)
    eyes = by_condition(rows, "eyes")
    assert set(eyes) == {Condition.of("dice", one, "rce", colour="red") for one in OPTIONS.systems}
    assert all(len(values) == RUNS for values in eyes.values()), "warm-ups do not count"
    assert sum(row.metric == DONE for row in rows) == len(OPTIONS.systems) * RUNS
    assert {key: len(values) for key, values in by_condition(rows, WORK).items()} == {
        work_condition(number): len(OPTIONS.systems) for number in (1, 2)
    }
    assert said[0] == "dice: preparing"
    assert said[1].endswith("warm-up (1 of 6; about 1 min left)")


def test_work_of_the_machine_uses_processor_time_of_its_thread() -> None:
    """That of other threads and processes does not count, nor does waiting."""
    before = time.thread_time()
    found = processor_time()
    assert 0 < found <= time.thread_time() - before


async def test_only_what_is_missing_is_done_again(tmp_path: Path) -> None:
    await runner(tmp_path, Dice(), [], runs=1).run()
    done = read_rows(tmp_path / TABLE)
    lost = next(row for row in reversed(done) if row.metric == DONE)
    (tmp_path / TABLE).unlink()
    write_rows(tmp_path / TABLE, [row for row in done if row != lost])

    dice, said = Dice(), list[str]()
    await runner(tmp_path, dice, said, runs=1).run()
    assert [trial.setup for trial in dice.trials] == [lost.condition] * 2, "its warm-up, and the run"
    assert dice.prepared == 0, "it is in the table"
    again = read_rows(tmp_path / TABLE)
    assert [row.run for row in again if row.metric == WORK] == [1, 2, 3], "one more before the run"
    assert sorted(row.metric for row in again) == sorted([*(row.metric for row in done), WORK])
    assert by_condition(again, "eyes") == by_condition(done, "eyes"), "a run has the same seed again"

    await runner(tmp_path, dice, said, runs=1).run()
    assert said[-1] == "dice: all runs are done"


async def test_a_run_that_fails_is_tried_again_once(tmp_path: Path) -> None:
    dice, said = Dice(), list[str]()
    dice.fails = 1
    await runner(tmp_path, dice, said).run()
    assert any("is tried again: the dice fell off the table" in line for line in said)
    dice.fails = 2
    with pytest.raises(ExperimentError, match=r"dice: \w+ rce, warm-up: the dice fell off the table"):
        await runner(tmp_path, dice, said, runs=RUNS + 1).run()
    assert len(by_condition(read_rows(tmp_path / TABLE), "eyes")) == len(OPTIONS.systems), (
        "what is done stays"
    )


async def test_other_seeds_make_another_order(tmp_path: Path) -> None:
    orders = []
    for seed in range(6):
        dice, folder = Dice(), tmp_path / str(seed)
        folder.mkdir()
        await runner(folder, dice, [], runs=1, seed=seed).run()
        orders.append(tuple(trial.setup.system for trial in dice.trials))
    assert len(set(orders)) > 1


@pytest.mark.parametrize(
    ("options", "runs", "minutes"),
    [
        (Options(software=USUAL), RUNS_OF_ALL, 120),
        (Options(software=USUAL, robots=QUICK_ROBOTS, seconds=QUICK_SECONDS, quick=True), 1, 3),
    ],
    ids=["all", "quick"],
)
def test_all_experiments_are_planned_to_fit(options: Options, runs: int, minutes: float) -> None:
    """With the software that a machine with ROS has; a plan needs neither ROS nor machines."""
    plan = Plan(list(EXPERIMENTS.values()), options, runs, 1)
    assert sum(plan.seconds(one, []) for one in plan.experiments) <= 60 * minutes


def test_the_rest_takes_as_long_as_what_was_done() -> None:
    now = 100.0
    pace = Pace(600.0, lambda: now)
    assert pace.left() == 600.0
    pace.done(SAMPLE_S - 1.0)
    assert pace.left() == 601.0 - SAMPLE_S, "that is not enough to tell"
    pace.done(201.0 - SAMPLE_S)
    now += 100.0
    assert pace.left() == 200.0, "twice as fast as planned"
    pace.done(500.0)
    assert pace.left() == 0.0


class Meeting(Dice):
    """Dice that are only thrown while another throw is under way, and then have several figures."""

    def __init__(self) -> None:
        super().__init__()
        self.under_way = 0
        self.met = asyncio.Event()

    def preparation_seconds(self, options: Options) -> float:
        del options
        return 0.0

    async def measure(self, trial: Trial) -> list[Measured]:
        self.under_way += 1
        if self.under_way > 1:
            self.met.set()
        async with asyncio.timeout(60):
            await self.met.wait()
        self.under_way -= 1
        return trial.measured([Value(f"eyes{number}", 1.0, "") for number in range(9)])


async def test_each_round_has_runs_of_all_experiments(tmp_path: Path) -> None:
    """What changes in the hours of a plan meets all of them."""
    thrown: list[str] = []

    class Second(Dice):
        name = "coins"

        async def measure(self, trial: Trial) -> list[Measured]:
            thrown.append(self.name)
            return await super().measure(trial)

    class First(Second):
        name = "dice"

    write_link(tmp_path)
    await Runner(Plan([First(), Second()], OPTIONS, RUNS, 1), tmp_path, print).run()
    assert thrown == (["dice"] * 2 + ["coins"] * 2) * (1 + RUNS)


class WaitingMeeting(Meeting):
    """One of which two runs are done at the same time in any plan."""

    at_once = 2


@pytest.mark.parametrize(("meeting", "options"), [(Meeting(), QUICK), (WaitingMeeting(), OPTIONS)])
async def test_runs_that_may_be_are_done_at_once(tmp_path: Path, meeting: Meeting, options: Options) -> None:
    """Their rows stay together, so that a resumed plan finds each one complete."""
    await runner(tmp_path, meeting, [], options=options).run()
    rows = [row for row in read_rows(tmp_path / TABLE) if row.condition.experiment == "dice"]
    assert [row.metric for row in rows].count(DONE) == len(OPTIONS.systems) * RUNS
    runs = [(row.condition.system, row.run) for row in rows]
    assert [key for key, _ in groupby(runs)] == list(dict.fromkeys(runs))
    assert not by_condition(read_rows(tmp_path / TABLE), WORK), "other runs would be measured with it"


class Stuck(Dice):
    """Dice of which the first throw does not end, and the others fail."""

    async def measure(self, trial: Trial) -> list[Measured]:
        self.trials.append(trial)
        if len(self.trials) == 1:
            await asyncio.Event().wait()
        raise ExperimentError("the dice fell off the table")


async def test_an_error_of_a_quick_plan_ends_its_other_runs(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match="the dice fell off the table"):
        await runner(tmp_path, Stuck(), [], options=QUICK).run()


async def test_an_error_of_the_system_names_the_run(tmp_path: Path) -> None:
    """As a full disk: it is told as other errors are, and what is done stays."""

    class Full(Dice):
        async def measure(self, trial: Trial) -> list[Measured]:
            if len(self.trials) < len(OPTIONS.systems):
                return await super().measure(trial)
            (tmp_path / "missing" / "images").write_bytes(b"")
            raise AssertionError

    with pytest.raises(ExperimentError, match=r"dice: \w+ rce, run 1: .*missing/images: No such file"):
        await runner(tmp_path, Full(), []).run()


@pytest.mark.parametrize("step", [-3600.0, 0.5, 7200.0])
async def test_a_run_in_which_the_clock_was_set_is_done_again(tmp_path: Path, step: float) -> None:
    """By a time server, or because the machine slept: delays and rates of such a run are wrong."""

    class Sleeping(Dice):
        async def measure(self, trial: Trial) -> list[Measured]:
            measured = await super().measure(trial)
            if len(self.trials) == 5:
                ahead.append(step)
            return measured

    ahead, dice, said = [0.0], Sleeping(), list[str]()
    await runner(tmp_path, dice, said, wall=lambda: time.time() + sum(ahead)).run()
    assert f"the clock of this machine was set by {step:+.2f} s meanwhile, or the machine slept" in "".join(
        said
    )
    tries = [row.value for row in read_rows(tmp_path / TABLE) if row.metric == TRIED]
    assert sorted(tries) == [1.0, 1.0, 1.0, 2.0]
    assert len(dice.trials) == 7, "two warm-ups, four runs, and one of them again"
