"""Plans for robots that need time to turn and stop, against an independent simulation of their execution."""

from __future__ import annotations

from math import nan, pi
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.exceptions import PlanningError
from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.execution import execution_times
from rce_fleet.planning.graph import Edge, PlanningGraph
from rce_fleet.planning.grid import GridMap
from rce_fleet.planning.guidance import DOWN, LEFT, RIGHT, UP
from rce_fleet.planning.lacam import LacamPlanner
from rce_fleet.planning.motion import UNKNOWN, Motion, Turning, edge_directions, heading_of
from rce_fleet.planning.planner import JointPlan, PlanningProblem

TICKS = 4
"""Ticks of the simulation in a step."""
ROBOT = Motion(quarter_turn=0.75, stop=0.5)


class Simulation:
    """Drives robots tick by tick. Shares no code with the planners.

    Each cell has a queue of its visitors in the plan's order. A robot turns, waits until it is first in the
    next cell's queue, drives, and then leaves the queue of the cell behind it.
    """

    def __init__(self, joint: JointPlan, columns: int, motion: Motion) -> None:
        self.motion = motion
        self.routes = [joint.route(robot) for robot in range(joint.cells.shape[1])]
        self.queues: dict[int, list[int]] = {}
        visits = [(step, robot, cell) for robot, route in enumerate(self.routes) for step, cell in route]
        for _, robot, cell in sorted(visits):
            self.queues.setdefault(cell, []).append(robot)
        self.angles = {1: 0, columns: 1, -1: 2, -columns: 3}
        headings = motion.headings or (UNKNOWN,) * len(self.routes)
        self.facing = [{RIGHT: 0, UP: 1, LEFT: 2, DOWN: 3}.get(heading) for heading in headings]
        zeros = [0] * len(self.routes)
        self.at, self.until, self.drive, self.ended = zeros[:], zeros[:], zeros[:], zeros[:]
        self.was_moving = [False] * len(self.routes)
        self.turned_for = [-1] * len(self.routes)

    def run(self) -> list[float]:
        """Return when each robot ends, steps."""
        robots = range(len(self.routes))
        for tick in range(10_000):
            for robot in robots:  # ends of moves first, so that followers start at once
                self._drive(robot, tick)
            for robot in robots:
                self._start(robot, tick)
            if all(self.at[robot] + 1 == len(self.routes[robot]) for robot in robots):
                return [tick / TICKS for tick in self.ended]
        raise AssertionError("the robots wait for each other")

    def _drive(self, robot: int, tick: int) -> None:
        if self.drive[robot]:
            self.drive[robot] -= 1
            if not self.drive[robot]:
                self.queues[self.routes[robot][self.at[robot]][1]].pop(0)
                self.at[robot] += 1
                self.was_moving[robot] = True
                self.ended[robot] = tick

    def _start(self, robot: int, tick: int) -> None:
        at = self.at[robot]
        if self.drive[robot] or at + 1 == len(self.routes[robot]):
            return
        here, there = self.routes[robot][at][1], self.routes[robot][at + 1][1]
        if self.turned_for[robot] < at:
            self.turned_for[robot] = at
            angle, old = self.angles[there - here], self.facing[robot]
            quarters = 0 if old is None else min((angle - old) % 4, (old - angle) % 4)
            self.until[robot] = tick + round(quarters * self.motion.quarter_turn * TICKS)
            self.facing[robot] = angle
        if self.until[robot] > tick or self.queues[there][0] != robot:
            self.was_moving[robot] = False
            return
        self.drive[robot] = TICKS + (0 if self.was_moving[robot] else round(self.motion.stop * TICKS))


def simulate(joint: JointPlan, columns: int, motion: Motion) -> list[float]:
    return Simulation(joint, columns, motion).run()


def drawn(seed: int, count: int, share: float, side: int) -> tuple[GridMap, list[int], list[int]]:
    """A random map, starts and goals in its largest part."""
    rng = Random(seed)
    grid = GridMap(side, side, blocked=frozenset(rng.sample(range(side * side), int(share * side * side))))
    part = max((sorted(grid.reachable(cell)) for cell in grid.free), key=len)
    count = max(min(count, len(part) // 2), 1)
    return grid, rng.sample(part, count), rng.sample(part, count)


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 12),
    share=st.floats(0.0, 0.25),
    rotations=st.booleans(),
    has_headings=st.booleans(),
)
def test_motion_plans_keep_rules_and_expected_times(
    seed: int, count: int, share: float, rotations: bool, has_headings: bool
) -> None:
    """The plan has no conflicts, and the expected times are those of the independent simulation."""
    grid, starts, goals = drawn(seed, count, share, 7)
    headings = tuple(Random(seed).randrange(5) for _ in starts) if has_headings else ()
    motion = Motion(0.75, 0.5, headings)
    problem = PlanningProblem.of(
        PlanningGraph.from_grid(grid), starts, goals, seed=seed, effort=30_000, rotations=rotations,
        motion=motion,
    )  # fmt: skip
    joint = LacamPlanner(compiled=False).plan(problem)
    paths = [joint.path(robot) for robot in range(len(starts))]
    wanted = goals if joint.complete else None
    assert check_plan(grid, paths, starts=starts, goals=wanted, rotations=rotations) == []
    if not check_plan(grid, paths, rotations=False):
        assert execution_times(joint.cells, 7, motion).tolist() == simulate(joint, 7, motion)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.15])
def test_plans_with_turns_counted_are_carried_out_sooner(share: float) -> None:
    """On average over random maps, by the independent simulation, by at least a tenth."""
    with_turns, without = 0.0, 0.0
    for seed in range(4):
        grid, starts, goals = drawn(seed, 10, share, 12)
        graph = PlanningGraph.from_grid(grid)
        for motion in (ROBOT, None):
            joint = LacamPlanner(compiled=False).plan(
                PlanningProblem.of(graph, starts, goals, seed=seed, effort=20_000, motion=motion)
            )
            assert joint.complete
            took = sum(simulate(joint, 12, ROBOT))
            if motion is None:
                without += took
            else:
                with_turns += took
    assert with_turns < 0.9 * without


def test_one_robot_alone_takes_the_path_with_fewest_turns() -> None:
    problem = PlanningProblem.of(
        PlanningGraph.from_grid(GridMap(6, 6)), [0], [35], motion=Motion(1.0, 0.0, (UP,))
    )
    path = LacamPlanner(compiled=False).plan(problem).path(0)
    assert path == [0, 6, 12, 18, 24, 30, 31, 32, 33, 34, 35]


def test_turning_costs_are_those_of_exhaustive_search() -> None:
    """The table of costs over edges equals a search over cells and headings, written a second time."""
    grid = GridMap(5, 6, blocked=frozenset({8, 9, 14, 21}))
    graph = PlanningGraph.from_grid(grid)
    directions = edge_directions(graph)
    turning = Turning.of(graph, directions, np.array([29], np.int32), Motion(0.5, 0.25))
    best = {(29, heading): 0.0 for heading in range(4)}
    offsets = {UP: 6, DOWN: -6, LEFT: -1, RIGHT: 1}
    ring = [UP, RIGHT, DOWN, LEFT]
    for _ in range(60):
        for cell in grid.free:
            for heading in range(4):
                for ahead, offset in offsets.items():
                    apart = abs(ring.index(ahead) - ring.index(heading))
                    turn = 0.25 * (apart > 0) + 0.5 * min(apart, 4 - apart)
                    if cell + offset in grid.neighbours[cell]:
                        through = best.get((cell + offset, ahead), 1e9) + 1 + turn
                        best[cell, heading] = min(best.get((cell, heading), 1e9), through)
    for edge, cell in enumerate(graph.neighbours.tolist()):
        rest = 0.0 if cell == 29 else best[cell, int(directions[edge])]
        assert turning.table[0, edge] / 4 == 1 + rest


def test_motion_follows_from_speed_and_acceleration() -> None:
    motion = Motion.of_robot(cell_size=1.0, speed=0.5, turn_rate=pi / 4, acceleration=0.5)
    assert motion == Motion(quarter_turn=1.0, stop=0.5)
    late = Motion.of_robot(cell_size=1.0, speed=1.0, turn_rate=pi / 2, turn_acceleration=pi)
    assert late.quarter_turn == pytest.approx(1.5)  # half a second to the highest rate, half a second back
    slow = Motion.of_robot(cell_size=1.0, speed=1.0, turn_rate=9.0, turn_acceleration=pi / 2)
    assert slow.quarter_turn == pytest.approx(2.0)  # it brakes half-way
    yaws = (0.1, pi / 2, pi, -pi, -pi / 2 + 0.2, nan)
    assert [heading_of(yaw) for yaw in yaws] == [RIGHT, UP, LEFT, LEFT, DOWN, UNKNOWN]


def test_bad_motion_is_refused_with_its_reason() -> None:
    graph = PlanningGraph.from_edges(2, [Edge(0, 1)])
    with pytest.raises(PlanningError, match="quarter_turn must be a number of steps, 0 or more, not -1"):
        Motion(quarter_turn=-1)
    with pytest.raises(PlanningError, match=r"the heading of robot 1 must be within 0 \.\. 4, not 7"):
        Motion(headings=(0, 7))
    with pytest.raises(PlanningError, match="2 headings for 1 robots"):
        PlanningProblem.of(graph, [0], [1], motion=Motion(headings=(0, 1)))
    with pytest.raises(PlanningError, match="on grids only"):
        LacamPlanner(compiled=False).plan(PlanningProblem.of(graph, [0], [1], motion=ROBOT))


def test_turns_are_left_out_where_they_hinder() -> None:
    """Robots that must change places in an aisle find a plan although turning away costs much."""
    grid = GridMap(3, 7, blocked=frozenset({0, 1, 2, 4, 5, 6, 14, 15, 16, 18, 19, 20}))
    problem = PlanningProblem.of(
        PlanningGraph.from_grid(grid), [7, 13, 8], [13, 7, 12], motion=Motion(5.0, 2.0, (RIGHT, LEFT, RIGHT))
    )
    joint = LacamPlanner(compiled=False).plan(problem)
    assert joint.complete
