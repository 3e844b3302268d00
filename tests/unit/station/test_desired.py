"""Requests that a restarted planner is told again, and nodes that are started again."""

from __future__ import annotations

from typing import Any

from rce.config.client import loads
from rce.config.documents import write_items
from rce.model.requests import ConfigureComponents, RemoveNode
from rce_fleet.station.desired import Desired, DesiredCell, DesiredGoal, node_requests
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


def test_complete_planner_state_needs_no_requests() -> None:
    desired = Desired()
    desired.set_goal("a", 5)
    desired.set_cell(DesiredCell(7, True))
    desired.set_cell(DesiredCell(8, True))
    assert desired.unmet(state(("a", 5), blocked=(7,), pending=(8,))) == []


def test_missing_cells_are_sent_before_goals() -> None:
    desired = Desired()
    desired.set_goal("a", 5)
    desired.set_cell(DesiredCell(7, True))
    assert desired.unmet(state(("a", -1), ("b", -1))) == [DesiredCell(7, True), DesiredGoal("a", 5)]


def test_a_cell_that_was_freed_is_freed_again() -> None:
    desired = Desired()
    desired.set_cell(DesiredCell(7, True))
    desired.set_cell(DesiredCell(7, False))
    assert desired.unmet(state(blocked=(7,))) == [DesiredCell(7, False)]
    assert desired.unmet(state()) == []


def test_a_cell_is_blocked_again_for_its_reason() -> None:
    """With what is left of its time; one whose time has come is not blocked again."""
    desired = Desired()
    wanted = DesiredCell(7, True, "ann", "spill", since=1000.0, until=1060.0)
    desired.set_cell(wanted)
    assert desired.unmet(state(), 1020.0) == [wanted]
    assert desired.holds(wanted)
    assert wanted.request(1020.0) == {
        "cell": 7,
        "blocked": True,
        "by": "ann",
        "reason": "spill",
        "age": 20.0,
        "lifetime": 40.0,
    }
    assert desired.unmet(state(), 1060.0) == []
    assert DesiredCell(7, True).request(5.0) == {"cell": 7, "blocked": True}, "an earlier planner knows it"


def test_walls_are_not_sent() -> None:
    desired = Desired()
    desired.set_cell(DesiredCell(0, False))
    assert desired.unmet(state()) == []


def test_other_goals_and_absent_robots_are_left_out() -> None:
    desired = Desired()
    desired.set_goal("a", 5)
    assert desired.unmet(state(("a", 9))) == []
    assert desired.unmet(state()) == []


def test_removed_goal_is_not_sent_again() -> None:
    desired = Desired()
    desired.set_goal("a", 5)
    desired.set_goal("a", None)
    assert desired.unmet(state(("a", -1))) == []


def engine(state: str, *nodes: tuple[str, str]) -> dict[str, Any]:
    listed = [{"tag": tag, "state": status, "detail": ""} for tag, status in nodes]
    return {"containers": [{"tag": "cTag_fleet", "state": state, "nodes": listed}]}


MANAGER = ("fleetManager", "running")


def test_a_running_node_needs_nothing() -> None:
    for status in ("running", "starting", "stopping", "unknown"):
        assert node_requests(CONFIG, engine("running", ("fleetPlanner", status), MANAGER)) == []


def test_a_node_that_failed_is_removed_and_then_added() -> None:
    (request,) = node_requests(CONFIG, engine("running", ("fleetPlanner", "failed"), MANAGER))
    assert isinstance(request, ConfigureComponents)
    assert request.remove_nodes == (RemoveNode(container="cTag_fleet", tag="fleetPlanner"),)
    (request,) = node_requests(CONFIG, engine("running", MANAGER))
    assert isinstance(request, ConfigureComponents)
    assert [node.node.tag for node in request.add_nodes] == ["fleetPlanner"]


def test_container_that_does_not_run_gets_no_requests() -> None:
    assert node_requests(CONFIG, engine("starting")) == []
    assert node_requests(CONFIG, engine("failed", ("fleetPlanner", "failed"))) == []
    assert node_requests(CONFIG, {"error": "the master cannot be reached"}) == []
