"""The long run: ``make faults ARGS="--only kill --rounds 100 --seed 7"``."""

from __future__ import annotations

import argparse
import asyncio
import secrets
import shutil
import sys
import traceback
from pathlib import Path

from support.short_folders import make_folder

from faults.catalogue import SCENARIOS, Scenario
from faults.goals import Times
from faults.world import world


def main() -> int:
    """Run scenarios; return the exit code."""
    names = [each.name for each in SCENARIOS]
    parser = argparse.ArgumentParser(prog="faults", description="Make faults, and check what the masters do.")
    parser.add_argument("--only", action="append", choices=names, help="Run this scenario only; repeatable.")
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**6), help="Repeat a run's choices.")
    parser.add_argument(
        "--rounds",
        type=int,
        default=100,
        help="Kills, 4 for a SIGTERM or drain, 8 for a cut of a kind; 1: each kind once.",
    )
    parser.add_argument("--keep", action="store_true", help="Keep the folder with all logs.")
    options = parser.parse_args()
    print(f"seed {options.seed}", flush=True)
    times, failed = Times(), []
    for scenario in SCENARIOS:
        if options.only and scenario.name not in options.only:
            continue
        print(f"--- {scenario.name}", flush=True)
        folder = make_folder()
        try:
            asyncio.run(_run(scenario, folder, options.seed, times, float(options.rounds)))
        except Exception as error:  # noqa: BLE001 - the other scenarios run, and the table is printed
            failed.append(scenario.name)
            said = isinstance(error, AssertionError)
            print(error if said else traceback.format_exc(), f"logs: {folder}", sep="\n", flush=True)
        else:
            if options.keep:
                print(f"logs: {folder}", flush=True)
            else:
                shutil.rmtree(folder)
    print("\n".join(times.table()))
    if failed:
        print(f"failed with seed {options.seed}: {', '.join(failed)}")
    return 1 if failed else 0


async def _run(scenario: Scenario, folder: Path, seed: int, times: Times, scale: float) -> None:
    async with world(folder, seed, times, scale=scale, robot=scenario.robot) as made:
        await scenario.run(made)


if __name__ == "__main__":
    sys.exit(main())
