"""The demo's scenario: map, starts and goals, drawn from a seed or read from MovingAI files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.floor import FLOOR
from rce_fleet.exceptions import FleetError
from rce_fleet.planning.dijkstra import shortest_path
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.movingai import read_scenario
from rce_fleet.planning.scenario import Scenario, given_scenario, make_scenario, spread_scenario

MIN_LONGEST_PATH = 6
"""Cells on the longest path, at least, so that a cell in its middle can be blocked on the way."""
MANY = 20
"""Scenarios of more robots have no boxes, and no joint plan is made to see whether they can be solved."""
_MAX_DRAWS = 1000


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
