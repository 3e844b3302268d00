"""Requests that a restarted planner is told again, and nodes that are started again."""

from __future__ import annotations

from typing import Any

from rce.config.client import loads
from rce.config.documents import write_items
from rce.protocol.messages import ConfigureComponents, RemoveNode
from rce_fleet.station.desired import Desired, DesiredCell, DesiredGoal
from rce_fleet.station.respawn import repairs
from rce_fleet.wiring import fleet_config

CONFIG = loads(write_items(fleet_config()))


def state(
    *robots: tuple[str, int], blocked: tuple[int, ...] = (), pending: tuple[int, ...] = ()
) -> dict[str, Any]:
    return {
        "blocked": [0, *blocked],
        "pending": list(pending),
        "walls": [0],
        "robots": [{"id": robot, "goal": goal} for robot, goal in robots],
    }


def test_a_planner_that_knows_everything_is_told_nothing() -> None:
    desired = Desired()
    desired.set_goal("a", 5)
    desired.set_cell(7, blocked=True)
    desired.set_cell(8, blocked=True)
    assert desired.unmet(state(("a", 5), blocked=(7,), pending=(8,))) == []


def test_a_planner_that_forgot_is_told_cells_first() -> None:
    desired = Desired()
    desired.set_goal("a", 5)
    desired.set_cell(7, blocked=True)
    assert desired.unmet(state(("a", -1), ("b", -1))) == [DesiredCell(7, True), DesiredGoal("a", 5)]


def test_a_cell_that_was_freed_is_freed_again() -> None:
    desired = Desired()
    desired.set_cell(7, blocked=True)
    desired.set_cell(7, blocked=False)
    assert desired.unmet(state(blocked=(7,))) == [DesiredCell(7, False)]
    assert desired.unmet(state()) == []


def test_walls_are_left_alone() -> None:
    desired = Desired()
    desired.set_cell(0, blocked=False)
    assert desired.unmet(state()) == []


def test_goals_of_others_and_robots_that_are_not_there_are_left_alone() -> None:
    desired = Desired()
    desired.set_goal("a", 5)
    assert desired.unmet(state(("a", 9))) == []
    assert desired.unmet(state()) == []


def test_a_goal_that_was_taken_back_is_forgotten() -> None:
    desired = Desired()
    desired.set_goal("a", 5)
    desired.set_goal("a", None)
    assert desired.unmet(state(("a", -1))) == []


def engine(state: str, *nodes: tuple[str, str]) -> dict[str, Any]:
    listed = [{"tag": tag, "state": status, "detail": ""} for tag, status in nodes]
    return {"containers": [{"tag": "cTag_fleet", "state": state, "nodes": listed}]}


def test_a_running_node_needs_nothing() -> None:
    for status in ("running", "starting", "stopping", "unknown"):
        assert repairs(CONFIG, engine("running", ("fleetPlanner", status))) == []


def test_a_node_that_failed_is_removed_and_then_added() -> None:
    (request,) = repairs(CONFIG, engine("running", ("fleetPlanner", "failed")))
    assert isinstance(request, ConfigureComponents)
    assert request.remove_nodes == (RemoveNode(container_tag="cTag_fleet", node_tag="fleetPlanner"),)
    (request,) = repairs(CONFIG, engine("running"))
    assert isinstance(request, ConfigureComponents)
    assert [node.node_tag for node in request.add_nodes] == ["fleetPlanner"]


def test_a_container_that_does_not_run_is_left_to_the_engine() -> None:
    assert repairs(CONFIG, engine("starting")) == []
    assert repairs(CONFIG, engine("failed", ("fleetPlanner", "failed"))) == []
    assert repairs(CONFIG, {"error": "the master cannot be reached"}) == []
