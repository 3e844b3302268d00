"""Folders of raw data: made for a new plan, or gone on in, by one command at a time."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments import environment
from rce_fleet.experiments.machines import check_machines
from rce_fleet.experiments.results import ENVIRONMENT, error_text

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce_fleet.experiments.runner import Plan

RUNS, SEED, ROBOTS = 10, 1, 5
"""Runs of each set-up that count, the seed, and robots, if neither the command nor the folder says."""


@dataclass(frozen=True, slots=True)
class Known:
    """The options with which a folder's raw data were begun, as a command gives them; None: not known."""

    seed: int = SEED
    robots: int = ROBOTS
    systems: str | None = None
    software: str | None = None
    quick: bool = False


def new_folder(planned: Plan, output: Path | None) -> Path:
    """Make the folder of a plan's raw data, and describe what they depend on.

    Args:
        planned: The plan.
        output: The folder; None: one that has the time in its name.

    Raises:
        ExperimentError: It exists or cannot be made, or machines cannot be made.
    """
    folder = output or Path(time.strftime("experiment-%Y%m%d-%H%M%S"))
    if folder.exists():
        is_started = (folder / ENVIRONMENT).is_file()
        way = f"go on in it with --resume {folder}" if is_started else "name a new folder"
        raise ExperimentError(f"{folder} exists already; {way}")
    asyncio.run(check_machines())
    description = environment.describe(planned.options, planned.seed, planned.runs)
    try:
        folder.mkdir(parents=True)
        environment.write(folder, description)
    except OSError as error:
        raise ExperimentError(f"--output {folder} cannot be made: {error_text(error)}") from error
    return folder


@contextlib.contextmanager
def used_alone(folder: Path) -> Iterator[None]:
    """Keep other commands from writing into a folder of raw data, until the block ends.

    Raises:
        ExperimentError: Another one writes into it.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ExperimentError(f"another command runs in {folder}; wait until it has ended") from None
        except OSError:  # a network file system may have no locks
            pass
        yield
    finally:
        os.close(descriptor)


def go_on(folder: Path, former: dict[str, Any], planned: Plan) -> None:
    """Make sure that machines can be made, and note how many runs there will be, and that it went on now.

    Args:
        folder: With the raw data so far.
        former: What they depend on.
        planned: What is done in it.

    Raises:
        ExperimentError: Machines cannot be made.
        OSError: The folder cannot be written.
    """
    asyncio.run(check_machines())
    runs = max(planned.runs, runs_of(former))
    resumed = [*_resumed(former), environment.now()]
    environment.write(folder, {**former, "runs": runs, "resumed": resumed})


def former_of(folder: Path) -> dict[str, Any]:
    """Return what a folder's raw data depend on.

    Raises:
        ExperimentError: It cannot be read.
    """
    try:
        return environment.read(folder)
    except (FileNotFoundError, NotADirectoryError):
        raise ExperimentError(
            f"--resume {folder}: it is not the folder of an experiment, for there is no {ENVIRONMENT}"
        ) from None
    except (OSError, ValueError) as error:
        raise ExperimentError(f"--resume {folder}: {error_text(error)}") from error


def runs_of(former: dict[str, Any]) -> int:
    """Return how many runs are made if the command does not say: as many as before.

    Args:
        former: What the raw data so far depend on; empty: there are none.
    """
    found = former.get("runs", RUNS)
    return found if isinstance(found, int) and found > 0 else RUNS


def known_options(former: dict[str, Any]) -> Known:
    """Return the options of a command that goes on, as far as it gives none itself.

    Args:
        former: What the raw data so far depend on; empty: there are none. What it says wrongly is left to
            :func:`check_same`.
    """
    found = former.get("options", {})
    seed, robots = former.get("seed"), found.get("robots")
    names = {key: found.get(key) for key in ("systems", "software")}
    return Known(
        seed=seed if isinstance(seed, int) else SEED,
        robots=robots if isinstance(robots, int) else ROBOTS,
        quick=found.get("quick") is True,
        **{key: ",".join(map(str, value)) for key, value in names.items() if isinstance(value, list)},
    )


def check_same(folder: Path, former: dict[str, Any], planned: Plan) -> None:
    """Make sure that a folder's raw data were made in the same way.

    Raises:
        ExperimentError: They were not.
    """
    description = environment.describe(planned.options, planned.seed, planned.runs)
    for key in environment.DECISIVE:
        if former.get(key) != description[key]:
            raise ExperimentError(
                f"--resume {folder}: its {key} is {_shown(former.get(key))}, now it is "
                f"{_shown(description[key])}; data of both cannot be in one table"
            )


def _resumed(former: dict[str, Any]) -> list[Any]:
    found = former.get("resumed", [])
    return found if isinstance(found, list) else []


def _shown(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)
