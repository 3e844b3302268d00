"""``rce experiment NAME``: the paper's experiments and more, on this machine."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Annotated, Any

import typer

from rce.own_process import EndSignals, end_signals
from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.catalogue import experiments_of
from rce_fleet.experiments.experiment import PAPER_SYSTEMS, Experiment, Options
from rce_fleet.experiments.folders import (
    ROBOTS,
    RUNS,
    SEED,
    check_same,
    former_of,
    go_on,
    known_options,
    new_folder,
    runs_of,
    used_alone,
)
from rce_fleet.experiments.ownership import measuring, sweep
from rce_fleet.experiments.report import make_report, read_second
from rce_fleet.experiments.results import TABLE, error_text
from rce_fleet.experiments.runner import Plan, Runner
from rce_fleet.experiments.systems.registry import system_of
from rce_fleet.experiments.systems.software import SOFTWARES, USUAL, software_of

PAGE = "experiments.md"
MAKE_PAGE = "page"
"""Name by which only the page is made."""
INTERRUPTED = 130
"""Exit code after Ctrl-C."""
QUICK_SECONDS = 2.0
QUICK_ROBOTS = 2
"""More robots show nothing that two do not."""


def experiment(
    name: Annotated[
        str,
        typer.Argument(metavar="NAME", help="The experiment, or all; page: run nothing.", show_default=False),
    ],
    folders: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[DIR]...",
            help="For page: folders of raw data that the page is made of.",
            show_default=False,
        ),
    ] = None,
    runs: Annotated[
        int | None,
        typer.Option(min=1, help="Runs of each set-up that count.", show_default=str(RUNS)),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Seed of the order of runs and of random choices.", show_default=str(SEED)),
    ] = None,
    *,
    quick: Annotated[
        bool, typer.Option("--quick", help="One short run of a few conditions, to see that all works.")
    ] = False,
    plan: Annotated[
        bool, typer.Option("--plan", help="Print what would run and how long it takes; run nothing.")
    ] = False,
    resume: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Go on where the run in this folder ended, with its options."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="New folder for the raw data.", show_default="experiment-TIME"),
    ] = None,
    robots: Annotated[
        int | None,
        typer.Option(min=1, max=20, help="Robots, where an experiment has no own.", show_default=str(ROBOTS)),
    ] = None,
    systems: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...", help="Systems that are compared.", show_default=",".join(PAPER_SYSTEMS)
        ),
    ] = None,
    software: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Software of the robots; the first one has all conditions.",
            show_default="those that are installed of ros,rce; roscpp if it is named",
        ),
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Page that is made of the raw data; its figures are in a folder of its name beside it.",
            show_default="experiments.md in the first folder",
        ),
    ] = None,
    second: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR|FILE",
            help="Raw data of another run, or its summary.csv: the page compares both. Repeatable.",
        ),
    ] = None,
) -> None:
    """Compare Single Master, Multi Master and Cloud Robotics System by experiments.

    Machines are network namespaces with links like a wireless LAN. Raw data go to results.csv in the folder,
    what they depend on to environment.json. A page of tables, figures and claims is made of them.
    """
    folder: Path | None = None
    try:
        if name == MAKE_PAGE:
            _report(folders or [], page, second or [])
            return
        experiments = _experiments(name, folders)
        former = _former(resume, output)
        known = known_options(former)
        options = _options(
            known.systems if systems is None else systems,
            known.software if software is None else software,
            robots or known.robots,
            quick=quick or known.quick,
        )
        count = 1 if options.quick else runs or runs_of(former)
        planned = Plan(experiments, options, count, known.seed if seed is None else seed)
        for line in planned.left_out():
            typer.echo(line)
        if resume is not None:
            check_same(resume, former, planned)
        if plan:
            _show(planned, resume)
            return
        _check_report(page, second or [])
        folder = resume or new_folder(planned, output)
        with used_alone(folder):
            if resume is not None:
                go_on(resume, former, planned)
            _measure(planned, folder)
            _report([folder], page, second or [])
    except (ExperimentError, OSError) as error:
        typer.echo(f"rce experiment: {error_text(error)}", err=True)
        if folder is not None:
            typer.echo(f"what is done stays; go on with --resume {folder}", err=True)
        raise typer.Exit(1) from error
    except (asyncio.CancelledError, KeyboardInterrupt):
        typer.echo("interrupted" + (f"; go on with --resume {folder}" if folder else ""), err=True)
        raise typer.Exit(INTERRUPTED) from None


def _experiments(name: str, folders: list[Path] | None) -> list[Experiment]:
    if folders:
        raise ExperimentError(f"only {MAKE_PAGE} takes folders; {name} writes to --output DIR")
    return experiments_of(name)


def _former(resume: Path | None, output: Path | None) -> dict[str, Any]:
    """Return what the raw data depend on that a command goes on with; nothing for a new folder."""
    if resume is None:
        return {}
    if output is not None:
        raise ExperimentError(
            "--resume DIR goes on in its folder; --output DIR needs a new one: give one of both"
        )
    return former_of(resume)


def _check_report(page: Path | None, second: list[Path]) -> None:
    """Make sure, before a run of hours, that its page can be made.

    Raises:
        ExperimentError: It cannot.
    """
    read_second(second)
    if page is None:
        return
    try:
        page.with_suffix("").mkdir(parents=True, exist_ok=True)
        page.open("a").close()
    except OSError as error:
        raise ExperimentError(f"--page {page} cannot be written: {error_text(error)}") from error


def _report(folders: list[Path], page: Path | None, second: list[Path]) -> None:
    """Make the page of folders with raw data."""
    if not folders:
        raise ExperimentError(f"{MAKE_PAGE} needs at least one folder of raw data")
    page = page or folders[0] / PAGE
    make_report(folders, page=page, figures=page.with_suffix(""), second=second)
    typer.echo(f"page: {page}")


def _measure(planned: Plan, folder: Path) -> None:
    """Do what is not done yet of a plan."""
    for left in sweep():
        typer.echo(f"removed what an experiment left that was killed: {left}")
    with contextlib.nullcontext(True) if planned.options.quick else measuring() as is_alone:
        if not is_alone:
            typer.echo(
                "another rce experiment runs on this computer: the figures of both are disturbed", err=True
            )
        asyncio.run(_run(Runner(planned, folder, typer.echo)))
    typer.echo(f"raw data: {folder / TABLE}")


async def _run(runner: Runner) -> None:
    task = asyncio.current_task()
    assert task is not None
    loop = asyncio.get_running_loop()
    EndSignals(task).handle()  # a second Ctrl-C does not stop the removal of what was made
    try:
        await runner.run()
    finally:
        for number in end_signals():
            with contextlib.suppress(ValueError):
                loop.remove_signal_handler(number)


def _options(systems: str | None, software: str | None, robots: int, *, quick: bool) -> Options:
    chosen = PAPER_SYSTEMS if systems is None else _names(systems, "--systems")
    for name in chosen:
        system_of(name)
    if software is None:
        names = tuple(name for name in USUAL if not SOFTWARES[name].missing())
    else:
        names = _names(software, "--software")
        for name in names:
            software_of(name)
    if quick:
        return Options(chosen, names, min(robots, QUICK_ROBOTS), QUICK_SECONDS, quick=True)
    return Options(chosen, names, robots)


def _names(text: str, option: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not names:
        raise ExperimentError(f"{option} needs at least one name")
    return names


def _show(planned: Plan, resume: Path | None) -> None:
    rows = []
    if resume is not None:
        rows = Runner(planned, resume, typer.echo).rows()
    total = 0.0
    for one in planned.experiments:
        seconds = planned.seconds(one, rows)
        total += seconds
        works = planned.works(one, rows)
        setups = len(one.setups(planned.options_of(one)))
        typer.echo(
            f"{one.name:12} {setups:3} set-ups {len(works):4} runs {seconds / 60:6.1f} min  {one.title}"
        )
    typer.echo(f"{'all' if len(planned.experiments) > 1 else 'in total':12} {total / 60:34.1f} min")
