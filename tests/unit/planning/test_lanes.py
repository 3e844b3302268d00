"""Lane graphs: their files, moves, costs and widths, and plans on them."""

from __future__ import annotations

import re
from math import inf
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import pytest

from rce_fleet.exceptions import LanesError
from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.fields import UNREACHABLE, distance_fields
from rce_fleet.planning.graph import PlanningGraph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.lane_files import parse_lanes, read_lanes
from rce_fleet.planning.lanes import Lane, LaneGraph
from rce_fleet.planning.motion import Motion
from rce_fleet.planning.planner import PlanningProblem, load_planner

GRID = GridMap(4, 5, cell_size=0.5, origin=(1.0, 2.0), blocked=frozenset({7}))
"""::

    15 16 17 18 19
    10 11 12 13 14
     5  6  #  8  9
     0  1  2  3  4
"""
RING = (0, 1, 2, 3, 4, 9, 14, 13, 12, 11, 10, 5, 0)


def test_a_file_has_nodes_by_cell_and_by_metres(tmp_path: Path) -> None:
    file = tmp_path / "lanes.yaml"
    file.write_text(
        "nodes:\n  dock: {cell: 0}\n  shelf: {x: 3.2, y: 2.1}\n"
        "lanes:\n"
        "  - {name: out, path: [dock, shelf], one_way: true, speed: 0.8, width: 1.2}\n"
        "  - {path: [4, 14, 10, dock], cost: 3}\n"
    )
    assert read_lanes(file, GRID).lanes == (
        Lane("out", (0, 1, 2, 3, 4), one_way=True, speed=0.8, width=1.2),
        Lane("lanes[1]", (4, 9, 14, 13, 12, 11, 10, 5, 0), cost=3),
    )


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ([], "the file: expected keys and values, found []"),
        ({"lane": []}, "the file: unknown key 'lane'; keys are nodes, lanes"),
        ({"lanes": []}, "lanes: expected a list of lanes"),
        ({"nodes": {"a": 3}, "lanes": []}, "nodes.a: expected keys and values, found 3"),
        ({"nodes": {"a": {"x": 1.2}}}, "nodes.a: expected {cell: NUMBER} or {x: METRES, y: METRES}"),
        ({"nodes": {"a": {"x": 9, "y": 2}}}, "nodes.a: the point (9, 2) is outside the map"),
        ({"nodes": {"a": {"x": "1", "y": 2}}}, "nodes.a.x: expected a number of"),
        ({"nodes": {"a": {"cell": 20}}}, "nodes.a.cell: expected a cell, 0 .. 19, found 20"),
        ({"lanes": [{"path": [0]}]}, "lanes[0].path: expected a list of two or more nodes or cells"),
        ({"lanes": [{"path": [0, "b"]}]}, "lanes[0].path[1]: unknown node 'b'; nodes are none"),
        ({"lanes": [{"path": [0, True]}]}, "lanes[0].path[1]: expected a cell, 0 .. 19, found True"),
        (
            {"lanes": [{"name": "up", "path": [0, 11]}]},
            "lanes[0] (up).path[1]: cell 11 is neither in the row nor in the column of cell 0",
        ),
        ({"lanes": [{"path": [0, 11]}]}, "name the corner between them too, cell 1 or 10"),
        ({"lanes": [{"path": [0, 0]}]}, "lanes[0].path[1]: cell 0 is the one before it; leave it out"),
        ({"lanes": [{"path": [5, 9]}]}, "lane 'lanes[0]' leads through cell 7, which is a wall"),
        ({"lanes": [{"path": [0, 1], "oneway": True}]}, "lanes[0]: unknown key 'oneway'; keys are name,"),
        ({"lanes": [{"path": [0, 1], "one_way": 1}]}, "lanes[0].one_way: expected true or false, found 1"),
        ({"lanes": [{"path": [0, 1], "speed": 0}]}, "lanes[0].speed: expected a number of 0.01 .. 100"),
        ({"lanes": [{"path": [0, 1], "cost": 1.5}]}, "lanes[0].cost: expected a whole number"),
        (
            {"lanes": [{"name": "a", "path": [0, 3]}, {"name": "b", "path": [3, 2]}]},
            "lanes 'a' and 'b' both lead from cell 3 to cell 2: end one of them before it",
        ),
    ],
)
def test_what_is_wrong_in_a_file_is_named(content: Any, text: str) -> None:
    with pytest.raises(LanesError, match=re.escape(text)):
        parse_lanes(content, GRID)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"lanes: [", "lanes.yaml, line 1: not YAML or JSON: "),
        (b"\xff", "not a text"),
        (None, "cannot be read"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, content: bytes | None, text: str) -> None:
    file = tmp_path / "lanes.yaml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(LanesError, match=re.escape(text)) as caught:
        read_lanes(file, GRID)
    assert str(caught.value).startswith(str(file))


def test_only_moves_of_lanes_are_open() -> None:
    """Lanes beside each other are not joined, where none leads across."""
    lanes = LaneGraph((Lane("low", (0, 1, 2), one_way=True), Lane("up", (2, 7, 12)), Lane("high", (5, 6))))
    grid = GridMap(4, 5)
    assert lanes.restrict(grid).free == [0, 1, 2, 5, 6, 7, 12]
    assert lanes.closed(grid) == {(1, 0), (2, 1), (0, 5), (5, 0), (1, 6), (6, 1), (6, 7), (7, 6)}


def test_costs_grow_as_speed_falls() -> None:
    fast, slow, dear = Lane("a", (0, 1), speed=1.0), Lane("b", (1, 2), True, 0.24), Lane("c", (2, 3), cost=30)
    lanes = LaneGraph((fast, slow, dear, Lane("d", (3, 4))))
    assert lanes.costs == {(1, 2): 4, (2, 3): 20, (3, 2): 20}
    assert lanes.speed_limit([0, 1, 2]) == 0.24
    assert lanes.speed_limit([2, 1, 0]) == 1.0
    assert lanes.speed_limit([2, 3, 4]) == lanes.speed_limit([1]) == inf


def test_lanes_that_are_too_narrow_are_left_out() -> None:
    wide, narrow, any_width = Lane("w", (0, 1), width=0.5), Lane("n", (1, 2), width=0.4), Lane("u", (2, 3))
    lanes, left_out = LaneGraph((wide, narrow, any_width)).fitting(0.44)
    assert lanes.lanes == (wide, any_width)
    assert left_out == (narrow,)


@pytest.mark.parametrize("columns", [1, 2])
def test_costs_of_moves_are_those_of_the_graph(columns: int) -> None:
    grid = GridMap(3, columns)
    lanes = LaneGraph(
        (Lane("up", (0, columns, 2 * columns), one_way=True, cost=5), Lane("down", (columns, 0), True))
    )
    graph = lanes.graph(grid)
    edges = {(node, int(to)) for node in lanes.cells for to in graph.edges_from(node)}
    assert edges == {(0, columns), (columns, 2 * columns), (columns, 0)}
    own = slice(graph.indptr[columns], graph.indptr[columns + 1])
    costs = dict(zip(graph.neighbours[own].tolist(), graph.costs[own].tolist(), strict=True))
    assert costs == {0: 1, 2 * columns: 5}


@pytest.mark.parametrize("name", ["lacam", "dijkstra"])
def test_plans_keep_to_the_direction_of_lanes(name: str) -> None:
    """On a ring of one-way lanes robots go the long way around."""
    lanes = LaneGraph((Lane("ring", RING, one_way=True),))
    grid = lanes.restrict(GRID)
    problem = PlanningProblem.of(lanes.graph(GRID), starts=[3, 12], goals=[1, 13], seed=1)
    joint = load_planner(name).plan(problem)
    assert joint.complete
    paths = [joint.path(robot) for robot in range(2)]
    assert len(dict.fromkeys(paths[0])) == len(RING) - 2
    assert check_plan(grid, paths, one_way=lanes.closed(GRID)) == []


@pytest.mark.parametrize("name", ["lacam", "dijkstra"])
def test_plans_prefer_faster_lanes(name: str) -> None:
    lanes = LaneGraph(
        (Lane("slow", (0, 1, 2, 3, 4), speed=0.2), Lane("fast", (4, 9, 14, 13, 12, 11, 10, 5, 0), speed=0.8))
    )
    problem = PlanningProblem.of(lanes.graph(GRID), starts=[0], goals=[4])
    assert 12 in load_planner(name).plan(problem).path(0)


@pytest.mark.parametrize("motion", [None, Motion(1.0, 0.5, (0,))], ids=["steps", "turns"])
def test_time_that_is_left_makes_no_dearer_plan(motion: Motion | None) -> None:
    """Improvement counts steps; the slow lane is shorter."""
    lanes = LaneGraph(
        (Lane("slow", (0, 1, 2, 3, 4), speed=0.1), Lane("fast", (4, 9, 14, 13, 12, 11, 10, 5, 0), speed=0.8))
    )
    problem = PlanningProblem.of(lanes.graph(GRID), starts=[0], goals=[4], seconds=0.05, motion=motion)
    joint = load_planner("lacam").plan(problem)
    assert 12 in joint.path(0)
    assert problem.extra_cost(joint.cells) == 0
    assert problem.extra_cost(np.arange(5, dtype=np.int32)[:, None]) == 4 * 7


def test_a_dear_edge_of_one_robot_is_not_taken() -> None:
    """The way behind it is short, and without this edge there is one around."""
    graph = PlanningGraph.from_grid(GridMap(2, 4))
    sources = np.repeat(np.arange(len(graph)), np.diff(graph.indptr))
    dear = np.where((sources == 1) & (graph.neighbours == 2), 100, graph.costs).astype(np.int32)
    problem = PlanningProblem.of(graph, starts=[1, 5], goals=[3, 4], own_costs={0: dear})
    assert load_planner("lacam").plan(problem).path(0) == [1, 5, 6, 7, 3]


def test_the_lanes_of_the_page_can_be_driven(tmp_path: Path) -> None:
    """Each cell of them can be reached from each other one."""
    page = (Path(__file__).parents[3] / "docs" / "how-to" / "lanes.md").read_text(encoding="utf-8")
    file = tmp_path / "lanes.yaml"
    file.write_text(dedent(page.partition("```yaml\n")[2].partition("   ```")[0]))
    grid = GridMap(2, 8)
    lanes = read_lanes(file, grid)
    cells = sorted(lanes.cells)
    assert len(cells) == 16
    assert (distance_fields(lanes.graph(grid), cells)[:, cells] < UNREACHABLE).all()


def test_long_ways_follow_fast_lanes_to_their_end() -> None:
    """After many steps too, in which no robot arrives."""
    grid = GridMap(2, 200)
    way, slow = tuple(range(101)), tuple(range(100, 200))
    around = (100, *range(300, 400), 199)
    lanes = LaneGraph(
        (
            Lane("way", way, speed=1.0),
            Lane("slow", slow, speed=0.1),
            Lane("around", around, speed=1.0),
        )
    )
    problem = PlanningProblem.of(lanes.graph(grid), starts=[0], goals=[199])
    joint = load_planner("lacam").plan(problem)
    assert joint.complete
    assert problem.extra_cost(joint.cells) == 0


@pytest.mark.parametrize(("seed", "count"), [(0, 32), (2, 32), (0, 40)])
def test_crowded_robots_do_not_pull_each_other_against_lanes(seed: int, count: int) -> None:
    """Also where the plan is not complete; the search for a place to pass ends in rings of one-way cells."""
    grid = GridMap(9, 13)
    rows = [tuple(range(row * 13, row * 13 + 13)) for row in (0, 4, 8)]
    columns = [tuple(range(column, 117, 13)) for column in (0, 6, 12)]
    steps = (1, -1, -1, -1, 1, 1)
    ways = [way[::step] for way, step in zip((*rows, *columns), steps, strict=True)]
    lanes = LaneGraph(tuple(Lane(str(way[0]), way, one_way=True) for way in ways))
    rng = np.random.default_rng(seed)
    starts, goals = (rng.choice(sorted(lanes.cells), count, replace=False).tolist() for _ in range(2))
    problem = PlanningProblem.of(lanes.graph(grid), starts, goals, seed=seed, effort=20_000, lifelong=True)
    joint = load_planner("lacam").plan(problem)
    paths = [joint.cells[:, robot].tolist() for robot in range(count)]
    assert check_plan(lanes.restrict(grid), paths, one_way=lanes.closed(grid), rotations=False) == []
