"""What the demo drives on: its own floor, or a public benchmark map."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

from rce_fleet.demo.exceptions import DemoError
from rce_fleet.exceptions import FleetError
from rce_fleet.planning.dijkstra import shortest_path
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.movingai import read_map, read_scenario
from rce_fleet.planning.scenario import Scenario, given_scenario, make_scenario

FLOOR = GridMap(rows=8, columns=8, cell_size=1.0, blocked=frozenset({26, 34, 29, 37}))
"""Eight by eight cells with two short walls in the middle."""
LONG_WAY = 6
"""Some robot has a way of at least so many cells, so that one on its middle can be blocked under way."""
_DRAWS = 1000


def draw(robots: int, seed: int, *, world: Path | None = None, scen: Path | None = None) -> Scenario:
    """The scenario of a demo.

    Args:
        robots: How many robots.
        seed: The same seed draws the same scenario.
        world: A map in MovingAI format; the demo's own floor if None.
        scen: Starts and goals for that map, of which the first ``robots`` rows are taken.

    Raises:
        DemoError: There is no such scenario.
    """
    grid = FLOOR
    if world is not None:
        with _naming(world):
            grid = read_map(world)
    if scen is None:
        with _naming("scenario"):
            return _draw_long(grid, robots, seed)
    with _naming(scen):
        rows = read_scenario(scen, grid, limit=robots)
        if len(rows) < robots:
            raise DemoError(f"{scen} has {len(rows)} rows, which is not enough for {robots} robots")
        return given_scenario(grid, [(row.start, row.goal) for row in rows], seed=seed)


@contextmanager
def _naming(source: object) -> Iterator[None]:
    """Say where a fault lies."""
    try:
        yield
    except (FleetError, OSError) as error:
        raise DemoError(f"{source}: {error}") from error


def _draw_long(grid: GridMap, robots: int, seed: int) -> Scenario:
    """A scenario in which at least one robot has a long way, where the map is large enough for that."""
    draws = Random(seed)  # noqa: S311 - draws scenarios, keeps no secret
    scenario = make_scenario(grid, robots, seed=seed)
    for _ in range(_DRAWS):
        if _longest(scenario) >= LONG_WAY:
            break
        scenario = make_scenario(grid, robots, seed=draws.getrandbits(32))
    return scenario


def _longest(scenario: Scenario) -> int:
    """Number of cells of the longest of the robots' shortest ways around all boxes."""
    grid = scenario.grid.with_blocked(scenario.grid.blocked | scenario.boxes)
    ends = zip(scenario.starts, scenario.goals, strict=True)
    return max(len(shortest_path(grid, start, goal) or ()) for start, goal in ends)
