"""The demo's scenario: map, lanes, starts and goals, drawn from a seed or read from files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from random import Random

from rce_fleet.demo.config import ROBOT_RADIUS
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.floor import FLOOR
from rce_fleet.exceptions import FleetError
from rce_fleet.planning.dijkstra import shortest_path
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lane_files import read_lanes
from rce_fleet.planning.lanes import LaneGraph
from rce_fleet.planning.movingai import read_scenario
from rce_fleet.planning.planner import PlanningProblem, load_planner
from rce_fleet.planning.scenario import Scenario, given_scenario, make_scenario, spread_scenario

MIN_LONGEST_PATH = 6
"""Cells on the longest path, at least, so that a cell in its middle can be blocked on the way."""
MANY = 20
"""Scenarios of more robots have no boxes, and no joint plan is made to see whether they can be solved."""
_MAX_DRAWS = 1000
_MAX_LANE_DRAWS = 100


def choose_scenario(robots: int, seed: int, *, grid: GridMap = FLOOR, scen: Path | None = None) -> Scenario:
    """Return the scenario of a demo.

    Args:
        robots: Number of robots.
        seed: The same seed draws the same scenario.
        grid: The cells.
        scen: Starts and goals on that map; the first ``robots`` rows are used.

    Raises:
        DemoError: A file cannot be read, or the robots do not fit on the map.
    """
    if scen is None:
        with _name_source("scenario"):
            if robots > MANY:
                return spread_scenario(grid, robots, seed=seed)
            return _draw_with_long_path(grid, robots, seed)
    with _name_source(scen):
        rows = read_scenario(scen, grid, limit=robots)
        if len(rows) < robots:
            raise DemoError(f"{scen} has {len(rows)} rows; {robots} robots need as many")
        return given_scenario(grid, [(row.start, row.goal) for row in rows], seed=seed)


def find_lanes(
    file: Path | None, grid: GridMap, *, slam: bool, blocked_cells: int | None
) -> LaneGraph | None:
    """Read the lanes of a demo.

    Args:
        file: YAML or JSON; None: there are no lanes.
        grid: The cells.
        slam: Whether the demo begins without a map.
        blocked_cells: How many cells are to be blocked, if that was given.

    Returns:
        Those that the demo's robots fit on.

    Raises:
        DemoError: They cannot be used.
    """
    if file is None:
        return None
    if slam:
        raise DemoError("--lanes lie on a map: use it without --slam")
    if blocked_cells:
        raise DemoError("--blocked-cells cuts lanes, and with them goals: use it without --lanes")
    with _name_source("--lanes"):
        lanes, narrow = read_lanes(file, grid).fitting(2 * ROBOT_RADIUS)
    if not lanes.lanes:
        width = f"{2 * ROBOT_RADIUS:g} m"
        raise DemoError(f"--lanes: {file}: all {len(narrow)} lanes are narrower than the robots, {width}")
    return lanes


def lane_scenario(
    robots: int, seed: int, *, grid: GridMap, lanes: LaneGraph, scen: Path | None = None
) -> Scenario:
    """Return a scenario without boxes whose starts and goals are on lanes that lead from each to all others.

    Args:
        robots: Number of robots.
        seed: The same seed draws the same scenario.
        grid: The cells.
        lanes: The lanes on them.
        scen: Starts and goals, as for :func:`choose_scenario`.

    Raises:
        DemoError: A file cannot be read, the robots do not fit on the lanes, or a start or goal is on none.
    """
    part = lanes.connected_part()
    if len(part) < 2:  # noqa: PLR2004 - a start and a goal
        raise DemoError("--lanes: from no cell lanes lead to another one and back; close them to a ring")
    if scen is not None:
        found = choose_scenario(robots, seed, grid=grid, scen=scen)
        for cell in (*found.starts, *found.goals):
            if cell not in part:
                raise DemoError(f"{scen}: from cell {cell} lanes do not lead to all others and back")
        return found
    ways = grid.with_blocked(cell for cell in range(len(grid)) if cell not in part)
    rng = Random(seed)  # noqa: S311 - for scenarios, not for secrets
    with _name_source("--lanes"):
        for _ in range(_MAX_LANE_DRAWS):
            found = replace(spread_scenario(ways, robots, seed=rng.getrandbits(32)), grid=grid)
            if robots > MANY or _is_solvable(found, lanes):
                return found
    raise DemoError(
        f"--lanes: found no starts and goals from which all {robots} robots can reach their goals; take fewer"
        " robots, or add bays beside the lanes"
    )


def _is_solvable(scenario: Scenario, lanes: LaneGraph) -> bool:
    """Whether a plan was found by which all robots are at their goals at the same time."""
    problem = PlanningProblem.of(lanes.graph(scenario.grid), starts=scenario.starts, goals=scenario.goals)
    return load_planner("lacam").plan(problem).complete


@contextmanager
def _name_source(source: object) -> Iterator[None]:
    """Put the source of an error in front of its text."""
    try:
        yield
    except (FleetError, OSError) as error:
        raise DemoError(f"{source}: {error}") from error


def _draw_with_long_path(grid: GridMap, robots: int, seed: int) -> Scenario:
    """Draw a scenario in which at least one robot has a long path, if the map is large enough."""
    rng = Random(seed)  # noqa: S311 - for scenarios, not for secrets
    scenario = make_scenario(grid, robots, seed=seed)
    for _ in range(_MAX_DRAWS):
        if _longest(scenario) >= MIN_LONGEST_PATH:
            break
        scenario = make_scenario(grid, robots, seed=rng.getrandbits(32))
    return scenario


def _longest(scenario: Scenario) -> int:
    """Return the number of cells of the longest of the robots' shortest paths around all boxes."""
    grid = scenario.grid.with_blocked(scenario.grid.blocked | scenario.boxes)
    ends = zip(scenario.starts, scenario.goals, strict=True)
    return max(len(shortest_path(grid, start, goal) or ()) for start, goal in ends)
