"""The station in a ROS graph: messages in their JSON form, and the graph as the page shows it."""

from __future__ import annotations

from rce.ros.packages import PackageIndex
from rce.ros.types import Time, TypeRegistry
from rce_fleet.station.graph_watch import graph_state
from rce_fleet.station.ros_planner_client import plain
from rce_fleet.station.view import FleetView

STATE = TypeRegistry(PackageIndex([])).message("fleet/FleetState")


def test_a_state_has_the_form_that_the_view_takes() -> None:
    robot = {"id": "Robot1", "state": "driving", "cell": 4, "goal": -1, "plan": [4, 5], "granted": [4]}
    message = STATE.new(rows=2, columns=3, cell_size=1.0, blocked=[3], robots=[robot])
    read = STATE.deserialize(STATE.serialize(message))
    view = FleetView()
    view.on_state(plain(read))
    assert view.blocked() == [3]
    (shown,) = view.robots()
    assert (shown["cell"], shown["goal"], shown["plan"]) == (4, None, [4, 5])


def test_times_differ_when_planners_do() -> None:
    first, second = (plain(STATE.new(started=Time(5, nanoseconds)))["started"] for nanoseconds in (1, 10))
    assert first == "5.000000001"
    assert first != second


def test_each_node_of_a_graph_is_shown_once_with_what_it_does() -> None:
    system = [
        [["/map", ["/planner"]], ["/pose", ["/robot"]]],
        [["/pose", ["/planner", "/ui"]]],
        [["/fleet/set_goal", ["/planner"]]],
    ]
    shown = graph_state("http://here:1/", system)["graph"]
    assert shown["uri"] == "http://here:1/"
    assert shown["nodes"] == [
        {"name": "/planner", "publishes": 1, "subscribes": 1, "serves": 1},
        {"name": "/robot", "publishes": 1, "subscribes": 0, "serves": 0},
        {"name": "/ui", "publishes": 0, "subscribes": 1, "serves": 0},
    ]
