"""Solves a batch of queued tasks with OR-Tools' routing library: ``pip install 'rce[routing]'``.

Each robot is a vehicle with an open route. What is least is the sum of the times at which tasks are done,
each with its weight, with what is late in addition. Local search begins with the present queues; guided local
search leads it out of local minima: C. Voudouris, E. Tsang, "Guided local search and its application to the
traveling salesman problem" (1999).
"""

from __future__ import annotations

from math import ceil, inf
from time import process_time
from typing import TYPE_CHECKING

from ortools.constraint_solver.pywrapcp import (
    DefaultRoutingSearchParameters,
    RoutingIndexManager,
    RoutingModel,
)
from ortools.constraint_solver.routing_enums_pb2 import LocalSearchMetaheuristic

from rce_fleet.tasks.routing_problem import LONGEST_S

if TYPE_CHECKING:
    from rce_fleet.tasks.routing_problem import RoutingProblem

_TICKS = 10
"""The solver counts in whole numbers: so many of them are a second."""
_MOST_CLOCK = 30
"""Seconds of the clock for a search, however little of the processor it gets."""


def improve(problem: RoutingProblem, seconds: float) -> list[list[int]] | None:
    """Return better routes than the present ones.

    Args:
        problem: Robots and tasks.
        seconds: Processor time that the search takes.

    Returns:
        The tasks of each robot, in order; None: no better ones were found.
    """
    robots, tasks = len(problem.ready), len(problem.weights)
    end = robots + tasks
    manager = RoutingIndexManager(end + 1, robots, list(range(robots)), [end] * robots)
    model = RoutingModel(manager)
    _count_times(model, problem)
    _limit_lengths(model, problem)
    _allow_moves(model, problem)
    parameters = DefaultRoutingSearchParameters()
    parameters.local_search_metaheuristic = LocalSearchMetaheuristic.GUIDED_LOCAL_SEARCH
    parameters.time_limit.FromSeconds(_MOST_CLOCK)
    until = process_time() + seconds
    model.AddSearchMonitor(model.solver().CustomLimit(lambda: process_time() > until))
    model.CloseModelWithParameters(parameters)
    routes = [[robots + task for task in queue] for queue in problem.queues]
    present = model.ReadAssignmentFromRoutes(routes, ignore_inactive_indices=False)
    if present is None:  # a queue that cannot be done
        return None
    found = model.SolveFromAssignmentWithParameters(present, parameters)
    if found is None or found.ObjectiveValue() >= present.ObjectiveValue():
        return None
    routes = []
    for robot in range(robots):
        route, index = [], found.Value(model.NextVar(model.Start(robot)))
        while not model.IsEnd(index):
            route.append(manager.IndexToNode(index) - robots)
            index = found.Value(model.NextVar(index))
        routes.append(route)
    return routes


def _count_times(model: RoutingModel, problem: RoutingProblem) -> None:
    """Count when each task is done, and what that costs.

    A place of the problem is a node of the model; the last node is the end of all routes. In a model with one
    end and a start for each robot, starts and tasks have their nodes' numbers as indices too.
    """
    robots = len(problem.ready)
    horizon = _horizon(problem)
    tables = [_register(model, table, robots, horizon) for table in problem.seconds]
    transits = [tables[profile] for profile in problem.profiles]
    names = ["done", "late"] if any(deadline < inf for deadline in problem.deadlines) else ["done"]
    for name in names:
        model.AddDimensionWithVehicleTransits(transits, 0, horizon, False, name)
        times = model.GetDimensionOrDie(name)
        for robot, ready in enumerate(problem.ready):
            times.CumulVar(model.Start(robot)).SetValue(round(_TICKS * ready))
    done = model.GetDimensionOrDie("done")
    for task, weight in enumerate(problem.weights):
        done.SetCumulVarSoftUpperBound(robots + task, 0, weight)
    if "late" in names:
        late = model.GetDimensionOrDie("late")
        for task, deadline in enumerate(problem.deadlines):
            if deadline < inf:
                bound = max(0, round(_TICKS * deadline))
                late.SetCumulVarSoftUpperBound(robots + task, bound, round(problem.late))


def _horizon(problem: RoutingProblem) -> int:
    """Return a time at which every route that is possible has ended, in ticks."""
    finite = (each for table in problem.seconds for row in table for each in row if each < LONGEST_S)
    length = max(problem.length, *map(len, problem.queues))
    return ceil(_TICKS * (max(problem.ready) + (length + 1) * max(finite, default=0.0)))


def _register(model: RoutingModel, table: list[list[float]], robots: int, horizon: int) -> int:
    """Register how long tasks take from each place; none ends at a robot, and the end is near to all."""
    never = horizon + 1
    rows = [
        [*[never] * robots, *(round(_TICKS * each) if each < LONGEST_S else never for each in row), 0]
        for row in table
    ]
    number: int = model.RegisterTransitMatrix([*rows, [never] * (len(table) + 1)])
    return number


def _limit_lengths(model: RoutingModel, problem: RoutingProblem) -> None:
    robots, tasks = len(problem.ready), len(problem.weights)
    one_each = model.RegisterUnaryTransitVector([*[0] * robots, *[1] * tasks, 0])
    room = [max(problem.length, len(queue)) for queue in problem.queues]
    model.AddDimensionWithVehicleCapacity(one_each, 0, room, True, "length")


def _allow_moves(model: RoutingModel, problem: RoutingProblem) -> None:
    """Let tasks go to robots that may do them; each that gets another robot must save some time."""
    robots, tasks = len(problem.ready), len(problem.weights)
    owners = problem.owners()
    keep = [round(_TICKS * problem.keep * weight) for weight in problem.weights]
    for robot in range(robots):
        moved = (0 if owners[task] == robot else keep[task] for task in range(tasks))
        cost = model.RegisterUnaryTransitVector([*[0] * robots, *moved, 0])
        model.SetArcCostEvaluatorOfVehicle(cost, robot)
    for task, able in enumerate(problem.able):
        model.VehicleVar(robots + task).SetValues(sorted({*able, owners[task]}))
