"""``rce plan MAP``: joint plans and lifelong runs on MovingAI maps, without an engine."""

from __future__ import annotations

import json
import sys
import time
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from rce_fleet.compiled import compile_kernels
from rce_fleet.exceptions import FleetError, PlanningError
from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.fields import LANES, UNREACHABLE, distance_fields
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.lacam import LacamPlanner, can_improve
from rce_fleet.planning.lane_files import read_lanes
from rce_fleet.planning.lifelong import LIFELONG_KERNELS, LifelongPlanner, LifelongSettings
from rce_fleet.planning.movingai import read_map, read_scenario
from rce_fleet.planning.planner import (
    DEFAULT_EFFORT,
    DEFAULT_PLANNER,
    JointPlan,
    PlanningProblem,
    load_planner,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rce_fleet.planning.grid import GridMap

_EFFORT_PER_ROBOT = 4000
"""Configurations of a search for a first plan at most, if this is more than the default."""


def plan(
    map_: Annotated[Path, typer.Argument(metavar="MAP", help="MovingAI map.", show_default=False)],
    robots: Annotated[int, typer.Option(min=1, help="Number of robots.")],
    output: Annotated[Path, typer.Option(help="JSON file for the plan.")] = Path("plan.json"),
    scen: Annotated[Path | None, typer.Option(help="MovingAI scenario: starts and goals.")] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="Time to plan; 0 (default): end with the first plan.")
    ] = None,
    planner: Annotated[str | None, typer.Option(help="Planner, by its name; lacam by default.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of random choices.")] = 0,
    lanes: Annotated[
        Path | None, typer.Option(help="File of lanes that robots keep to.", show_default=False)
    ] = None,
    *,
    lifelong: Annotated[
        bool, typer.Option("--lifelong", help="Give each robot one goal after another.")
    ] = False,
    steps: Annotated[int, typer.Option(min=1, help="With --lifelong: number of steps.")] = 500,
) -> None:
    """Plan robots on a map without an engine.

    A robot moves by one cell a step. A cell's number is row * width + column; row 0 is the file's first line.
    """
    with _errors():
        if lifelong:
            unused = {"--scen": scen, "--seconds": seconds, "--planner": planner, "--lanes": lanes}
            if given := [name for name, value in unused.items() if value is not None]:
                raise PlanningError(
                    f"--lifelong has starts, goals and a planner of its own; leave out {', '.join(given)}"
                )
            report = _lifelong(read_map(map_), robots, steps, seed)
        elif scen is None:
            raise PlanningError("a plan needs --scen FILE.scen with starts and goals, or --lifelong")
        else:
            name = planner or DEFAULT_PLANNER
            report = _one_shot(map_, scen, robots, seconds or 0.0, name, seed, lanes)
        output.write_text(json.dumps(report, separators=(",", ":")) + "\n", encoding="utf-8")
    shown = {name: value for name, value in report.items() if not isinstance(value, list)}
    typer.echo(f"{output}: " + ", ".join(f"{name} {value}" for name, value in shown.items()))


def _one_shot(
    map_: Path, scen: Path, robots: int, seconds: float, name: str, seed: int, file: Path | None
) -> dict[str, Any]:
    """Plan a scenario, on the lanes of a file if there is one; return the report."""
    found: list[float] = []
    began = time.perf_counter()
    planner = load_planner(name)
    if name == DEFAULT_PLANNER:
        planner = LacamPlanner(on_first=lambda _: found.append(time.perf_counter()))
    compile_s = time.perf_counter() - began
    grid = read_map(map_)
    lanes = None if file is None else read_lanes(file, grid)
    if lanes is not None:
        grid = lanes.restrict(grid)
    rows = read_scenario(scen, grid, limit=robots)
    if len(rows) < robots:
        raise PlanningError(f"{scen}: the scenario has {len(rows)} robots; --robots asks for {robots}")
    began = time.perf_counter()
    problem = PlanningProblem.of(
        PlanningGraph.from_grid(grid) if lanes is None else lanes.graph(grid),
        [row.start for row in rows],
        [row.goal for row in rows],
        seed=seed,
        effort=max(DEFAULT_EFFORT, _EFFORT_PER_ROBOT * robots),
        seconds=seconds,
        rotations=True,
    )
    built_s = time.perf_counter() - began
    bound = _lower_bound(problem)  # also says which goal has no path, before a search for a plan
    if seconds and name == DEFAULT_PLANNER and not can_improve(problem):
        typer.echo(
            f"rce plan: --seconds {seconds:g} only serves to find a plan: the tables to improve one take too"
            f" much memory for {robots} robots on this map",
            err=True,
        )
    began = time.perf_counter() - built_s
    joint = planner.plan(problem)
    found.append(time.perf_counter())
    if not joint.complete:
        if joint.impossible:
            raise PlanningError("no plan exists: all moves were tried, and the robots cannot pass each other")
        raise PlanningError(
            f"no plan was found in {found[-1] - began:.1f} s; try more --seconds or another --seed"
        )
    paths = _paths(joint)
    starts, goals = problem.starts.tolist(), problem.goals.tolist()
    one_way = () if lanes is None else lanes.closed(grid)
    faults = check_plan(grid, paths, starts=starts, goals=goals, one_way=one_way)
    if faults and joint.conflict_free:
        raise PlanningError(f"the planner {name!r} made a wrong plan; {faults[0]}")
    if faults:
        typer.echo(
            f"rce plan: the planner {name!r} plans each robot alone: {len(faults)} conflicts, the first in"
            f" {faults[0]}",
            err=True,
        )
    return {
        "robots": robots,
        "compile_s": round(compile_s, 4),
        "first_solution_s": round(found[0] - began, 4),
        "cost": joint.cost,
        "lower_bound": bound,
        "makespan": joint.makespan,
        "conflict_free": not faults,
        "paths": paths,
    }


def _paths(joint: JointPlan) -> list[list[int]]:
    columns = joint.cells.T.tolist()
    return [column[: last + 1] for column, last in zip(columns, joint.arrivals.tolist(), strict=True)]


def _lower_bound(problem: PlanningProblem) -> int:
    """Return the sum of the shortest distances.

    Raises:
        PlanningError: A goal cannot be reached.
    """
    total = 0
    for begin in range(0, len(problem.goals), LANES):  # a table for all goals could fill the memory
        starts, goals = problem.starts[begin : begin + LANES], problem.goals[begin : begin + LANES]
        distances = distance_fields(problem.graph.unweighted, goals)[np.arange(len(goals)), starts]
        if distances.max() >= UNREACHABLE:
            index = int(np.argmax(distances >= UNREACHABLE))
            raise PlanningError(
                f"robot {begin + index}: no path leads from its start, cell {starts[index]}, "
                f"to its goal, cell {goals[index]}"
            )
        total += int(distances.sum(dtype=np.int64))
    return total


def _lifelong(grid: GridMap, robots: int, steps: int, seed: int) -> dict[str, Any]:
    """Draw starts and goals and drive; return the report."""
    began = time.perf_counter()
    compile_kernels(LIFELONG_KERNELS)
    compile_s = time.perf_counter() - began
    cells = np.array(_largest_part(grid), np.int32)
    if robots >= len(cells):
        raise PlanningError(f"{robots} robots do not fit: the map has {len(cells)} connected free cells")
    rng = np.random.default_rng(seed)
    starts = rng.choice(cells, robots, replace=False)

    def next_goal(_: int, before: int) -> int:
        goal = before
        while goal == before:
            goal = int(rng.choice(cells))
        return goal

    began = time.perf_counter()
    planner = LifelongPlanner(
        PlanningGraph.from_grid(grid), starts, next_goal, seed=seed, settings=LifelongSettings()
    )
    rows, reached = [planner.cells], np.zeros((2, robots), np.int64)
    """Number of goals that each robot has reached, and the step of the last one."""
    first_s = 0.0
    for step in range(1, steps + 1):
        planner.step()
        rows.append(planner.cells)
        counts = np.fromiter(map(len, planner.goals), np.int64, robots)
        reached[:] = counts, np.where(counts > reached[0], step, reached[1])
        first_s = first_s or time.perf_counter() - began
    took = time.perf_counter() - began
    paths = np.stack(rows, axis=1).tolist()
    if faults := check_plan(grid, paths, starts=starts.tolist()):
        raise PlanningError(f"the lifelong planner made a wrong plan; {faults[0]}")
    tasks = int(reached[0].sum())
    return {
        "robots": robots,
        "compile_s": round(compile_s, 4),
        "first_solution_s": round(first_s, 4),
        "cost": int(reached[1].sum()),
        "lower_bound": _shortest_legs(PlanningGraph.from_grid(grid), starts.tolist(), planner.goals),
        "makespan": int(reached[1].max()),
        "conflict_free": True,
        "seconds_per_step": round(took / steps, 4),
        "tasks": tasks,
        "tasks_per_step": tasks / steps,
        "goals": planner.goals,
        "paths": paths,
    }


def _shortest_legs(graph: PlanningGraph, starts: list[int], goals: list[list[int]]) -> int:
    """Return the sum of the shortest distances from each robot's start to the goals that it reached."""
    befores: dict[int, list[int]] = {}
    for start, own in zip(starts, goals, strict=True):
        for before, goal in pairwise((start, *own)):
            befores.setdefault(goal, []).append(before)
    ends = sorted(befores)
    total = 0
    for begin in range(0, len(ends), LANES):
        block = ends[begin : begin + LANES]
        for goal, field in zip(block, distance_fields(graph, block), strict=True):
            total += int(field[befores[goal]].sum(dtype=np.int64))
    return total


def _largest_part(grid: GridMap) -> list[int]:
    """Return the cells of the largest connected part of the map."""
    rest = set(grid.free)
    largest: set[int] = set()
    while len(rest) > len(largest):
        part = grid.reachable(next(iter(rest)))
        rest -= part
        largest = max(largest, part, key=len)
    return sorted(largest)


@contextmanager
def _errors() -> Iterator[None]:
    """Print errors of the input as one line, and end with code 1."""
    try:
        yield
    except (FleetError, OSError) as error:
        typer.echo(f"rce plan: {error}", err=True)
        sys.exit(1)
