"""Costs of moves for which robots waited: learned by the second, bounded, forgotten, used in new paths."""

from __future__ import annotations

from itertools import pairwise

from unit.fleet.test_late_plans import PlannerHarness

from rce_fleet.coordination.congestion import EVERY, HALF_LIFE, MOST, LearnedCosts
from rce_fleet.coordination.events import GoalSet
from rce_fleet.coordination.fleet_state import FleetState
from rce_fleet.coordination.replanning import request_plan
from rce_fleet.coordination.robot import Phase, RobotRecord
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.planning.grid import GridMap

MOVE = 0, 1


def waiting_robot() -> tuple[FleetState, LearnedCosts]:
    """Return a floor on which a robot waits to make a move."""
    state = FleetState(GridMap(3, 3))
    record = state.robots["R1"] = RobotRecord("R1", 0, phase=Phase.ACTIVE, centred=True)
    state.ledger.place(record.id, MOVE[0])
    state.ledger.insert(record.id, [(MOVE[1], 1.0)])
    return state, LearnedCosts(state)


def look(learned: LearnedCosts, begin: float, seconds: float) -> float:
    """Look as often as the planner does; return the time after it."""
    for number in range(int(seconds / EVERY)):
        learned.look(begin + number * EVERY)
    return begin + seconds


def test_move_that_a_robot_waits_for_costs_more_and_more() -> None:
    state, learned = waiting_robot()
    now = look(learned, 0.0, 1.0)
    assert state.learned == {}
    costs = []
    for _ in range(10):
        now = look(learned, now, HALF_LIFE)
        costs.append(state.learned[MOVE])
    assert costs == sorted(costs)
    assert costs[-1] == MOST
    assert state.move_costs() == {MOVE: MOST}


def test_costs_are_forgotten() -> None:
    state, learned = waiting_robot()
    now = look(learned, 0.0, 5 * HALF_LIFE)
    state.ledger.grant("R1", 4)
    look(learned, now, 6 * HALF_LIFE)
    assert state.learned == {}


def test_looks_within_a_second_count_once() -> None:
    state, learned = waiting_robot()
    for _ in range(1000):
        learned.look(0.0)
    assert state.learned == {}


def test_learned_costs_are_in_plans_but_not_in_searches_for_better_paths() -> None:
    """Better paths are compared with those that robots have, which were planned with other costs."""
    state, settings = FleetState(GridMap(3, 3)), FleetSettings()
    state.learned = {MOVE: 2}
    assert request_plan(state, settings, 0, 0.0).move_costs == ((*MOVE, 2),)
    assert request_plan(state, settings, 0, 0.0, improve=True).move_costs == ()


def test_new_path_leads_around_moves_that_cost_more() -> None:
    """Straight on it is 4 moves, of which two cost 3 steps; around them it is 6."""
    harness = PlannerHarness(0, 63, settings=FleetSettings())
    harness.planner.state.learned = {(1, 2): 3, (2, 3): 3}
    harness.tell(GoalSet("R1", 4))
    harness.events(1)
    route = harness.planner.state.ledger.route("R1")
    assert len(route) == 7
    assert harness.planner.state.learned.keys().isdisjoint(pairwise(route))


def test_costs_are_learned_only_where_the_settings_say_so() -> None:
    """A look sets the costs: those of a move for which no robot waits are gone after it."""
    for learns in (False, True):
        harness = PlannerHarness(0, settings=FleetSettings(learn_congestion=learns))
        state = harness.planner.state
        state.learned = {(5, 6): 2}
        harness.events(1)
        assert state.learned == ({} if learns else {(5, 6): 2})
