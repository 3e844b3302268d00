"""Routes of robots through batches of tasks: allowed, and better than the present ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.tasks.routing_problem import RoutingProblem

REASON = "OR-Tools is missing (pip install rce[routing])"
improve = pytest.importorskip("rce_fleet.tasks.routing", reason=REASON).improve


def on_a_line(robots: Sequence[float], tasks: Sequence[float], queues: list[list[int]]) -> RoutingProblem:
    """Return robots that begin at some metres of a line, at a metre per second, and tasks at others."""
    table = [[abs(place - task) for task in tasks] for place in (*robots, *tasks)]
    everyone = list(range(len(robots)))
    return RoutingProblem(
        ready=[0.0] * len(robots),
        profiles=[0] * len(robots),
        seconds=[table],
        queues=queues,
        able=[everyone] * len(tasks),
        weights=[1] * len(tasks),
        deadlines=[inf] * len(tasks),
        late=2.0,
        length=3,
        keep=10.0,
    )


CROSSED = on_a_line([0.0, 100.0], [90.0, 10.0], [[0], [1]])


def cost(problem: RoutingProblem, routes: Sequence[Sequence[int]]) -> float:
    """Return what is to be least, in weighted seconds; ``inf`` if a robot cannot do a task from its place."""
    owner = problem.owners()
    total = 0.0
    for robot, route in enumerate(routes):
        time, place, table = problem.ready[robot], robot, problem.seconds[problem.profiles[robot]]
        for task in route:
            time, place = time + table[place][task], len(problem.ready) + task
            total += problem.weights[task] * time + problem.late * max(
                0.0, time - max(0.0, problem.deadlines[task])
            )
            total += problem.keep * problem.weights[task] * (owner[task] != robot)
    return total


def test_each_task_goes_to_the_robot_near_to_it() -> None:
    assert improve(CROSSED, 0.1) == [[1], [0]]


def test_what_saves_less_than_it_must_stays() -> None:
    """80 s are saved for each of the tasks."""
    assert improve(replace(CROSSED, keep=79.0), 0.1) == [[1], [0]]
    assert improve(replace(CROSSED, keep=81.0), 0.1) is None


@pytest.mark.parametrize(("keep", "moves"), [(79.0, True), (81.0, False)])
def test_what_must_be_saved_counts_with_the_weight(keep: float, moves: bool) -> None:
    important = replace(CROSSED, weights=[10, 10], keep=keep)
    assert improve(important, 0.1) == ([[1], [0]] if moves else None)


def test_a_robot_that_is_ready_late_gets_less() -> None:
    assert improve(replace(CROSSED, ready=[0.0, 500.0]), 0.1) == [[1, 0], []]


def test_a_robot_has_as_many_tasks_as_it_may() -> None:
    late = replace(CROSSED, ready=[0.0, 500.0], length=1)
    assert improve(late, 0.1) == [[1], [0]]


def test_a_queue_that_is_too_long_may_stay() -> None:
    """The rule was changed: no robot gets more, and none must give some away."""
    problem = on_a_line([0.0, 1000.0], [1.0, 2.0, 3.0], [[2, 1, 0], []])
    assert improve(replace(problem, length=1), 0.1) == [[0, 1, 2], []]


@pytest.mark.slow
def test_a_task_with_a_deadline_comes_first() -> None:
    """Both are as far away, so that the one that is late costs more."""
    problem = on_a_line([50.0], [0.0, 100.0], [[0, 1]])
    assert improve(problem, 0.1) is None
    assert improve(replace(problem, deadlines=[inf, 60.0]), 0.1) == [[1, 0]]
    assert improve(replace(problem, deadlines=[inf, -60.0]), 0.1) == [[1, 0]]


def test_a_task_with_a_higher_priority_comes_first() -> None:
    problem = on_a_line([50.0], [0.0, 100.0], [[0, 1]])
    assert improve(replace(problem, weights=[1, 2]), 0.1) == [[1, 0]]


def test_queues_that_cannot_be_done_stay() -> None:
    blocked = replace(CROSSED, seconds=[[[inf, 10.0], [10.0, inf], [0.0, inf], [inf, 0.0]]])
    assert improve(blocked, 0.1) is None
    endless = replace(CROSSED, seconds=[[[each * 1e9 for each in row] for row in CROSSED.seconds[0]]])
    assert improve(endless, 0.1) is None


@st.composite
def problems(draw: st.DrawFn) -> RoutingProblem:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    robots, length = draw(st.integers(1, 5)), draw(st.integers(1, 4))
    sizes = rng.integers(0, length + 1, robots).tolist()
    tasks, profiles = sum(sizes), draw(st.integers(1, 2))
    order = iter(rng.permutation(tasks).tolist())
    queues = [[next(order) for _ in range(size)] for size in sizes]
    seconds = rng.uniform(0.0, 100.0, (profiles, robots + tasks, tasks)).round(1)
    seconds[rng.random(seconds.shape) < draw(st.sampled_from((0.0, 0.3)))] = inf
    able = [sorted({*rng.choice(robots, rng.integers(0, robots + 1)).tolist()}) for _ in range(tasks)]
    deadlines = np.where(
        rng.random(tasks) < draw(st.sampled_from((0.0, 0.5))), rng.uniform(-50, 300, tasks).round(), inf
    )
    return RoutingProblem(
        ready=rng.uniform(0.0, 60.0, robots).round(1).tolist(),
        profiles=rng.integers(0, profiles, robots).tolist(),
        seconds=seconds.tolist(),
        queues=queues,
        able=able,
        weights=rng.integers(1, 11, tasks).tolist(),
        deadlines=deadlines.tolist(),
        late=2.0,
        length=length,
        keep=float(draw(st.sampled_from((0.0, 10.0)))),
    )


@pytest.mark.slow
@settings(max_examples=60)
@given(problems())
def test_routes_are_allowed_and_better(problem: RoutingProblem) -> None:
    routes = improve(problem, 0.02)
    if routes is None:
        return
    tasks = range(len(problem.weights))
    assert sorted(task for route in routes for task in route) == list(tasks)
    owner = problem.owners()
    for robot, (route, queue) in enumerate(zip(routes, problem.queues, strict=True)):
        assert len(route) <= max(problem.length, len(queue))
        assert all(robot in problem.able[task] or robot == owner[task] for task in route)
    assert cost(problem, routes) < cost(problem, problem.queues) + 1e-6
    assert cost(problem, routes) < inf


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_few_tasks_get_the_best_routes(seed: int) -> None:
    """Compared with all routes that there are."""
    rng = np.random.default_rng(seed)
    problem = replace(
        on_a_line(
            rng.uniform(0, 100, 2).round().tolist(), rng.uniform(0, 100, 4).round().tolist(), [[0, 1], [2, 3]]
        ),
        keep=0.0,
        length=4,
    )
    best = min(cost(problem, routes) for routes in all_routes(4))
    found = improve(problem, 0.2) or problem.queues
    assert cost(problem, found) == pytest.approx(best)


def all_routes(tasks: int) -> list[list[list[int]]]:
    """Return all ways to give tasks to two robots, in all orders."""
    routes: list[list[list[int]]] = [[[], []]]
    for task in range(tasks):
        routes = [
            [*before[:robot], [*before[robot][:place], task, *before[robot][place:]], *before[robot + 1 :]]
            for before in routes
            for robot in range(2)
            for place in range(len(before[robot]) + 1)
        ]
    return routes
