"""What the station knows of the fleet."""

from __future__ import annotations

from math import cos, pi, sin
from typing import Any

import pytest

from rce_fleet.station.live import MAX_EVENTS, Broadcast
from rce_fleet.station.view import FleetView


def robot(name: str, **changes: Any) -> dict[str, Any]:
    known = {
        "id": name,
        "state": "idle",
        "reason": "",
        "cell": 3,
        "goal": -1,
        "plan": [],
        "granted": [],
        "replans": 0,
    }
    return known | changes


def state(*robots: dict[str, Any], **changes: Any) -> dict[str, Any]:
    grid = {"rows": 8, "columns": 8, "cell_size": 1.0, "origin_x": 0.0, "origin_y": 0.0}
    return {**grid, "blocked": [], "walls": [], "pending": [], "robots": list(robots), **changes}


def pose(x: float, y: float, yaw: float) -> dict[str, Any]:
    orientation = {"x": 0.0, "y": 0.0, "z": sin(yaw / 2), "w": cos(yaw / 2)}
    return {"pose": {"pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": orientation}}}


def test_view_is_empty_before_the_first_state() -> None:
    view = FleetView()
    assert (view.map(), view.robots(), view.blocked(), view.pending()) == (None, [], [], [])


def test_negative_cells_mean_none() -> None:
    view = FleetView()
    view.on_state(state(robot("Robot1", cell=-1, goal=5)))
    assert view.robots()[0]["cell"] is None
    assert view.robots()[0]["goal"] == 5


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5, pi - 1e-6])
def test_reads_heading_of_a_quaternion(yaw: float) -> None:
    view = FleetView()
    view.on_state(state(robot("Robot1")))
    view.on_pose("Robot1", pose(1.0, 2.0, yaw))
    assert view.robots()[0]["pose"] == pytest.approx({"x": 1.0, "y": 2.0, "theta": yaw})


def test_pose_of_an_absent_robot_is_dropped() -> None:
    view = FleetView()
    view.on_state(state(robot("Robot1"), robot("Robot2")))
    view.on_pose("Robot1", pose(0, 0, 0))
    view.on_pose("Robot2", pose(0, 0, 0))
    view.on_state(state(robot("Robot2")))
    assert list(view.poses) == ["Robot2"]


async def test_a_slow_page_gets_only_the_newest_of_each_topic() -> None:
    pages = Broadcast()
    page = pages.open()
    for number in range(1000):
        pages.send("poses", f"poses {number}")
        pages.send("state", f"state {number}")
    assert await page.take() == ["poses 999", "state 999"]


async def test_a_page_that_opens_late_gets_what_is_known() -> None:
    pages = Broadcast()
    pages.send("map", "the map")
    pages.send_event("missed")
    assert await pages.open().take() == ["the map"]


async def test_events_are_kept_up_to_a_limit() -> None:
    pages = Broadcast()
    page, closed = pages.open(), pages.open()
    pages.close(closed)
    for number in range(MAX_EVENTS + 5):
        pages.send_event(f"event {number}")
    assert await page.take() == [f"event {number}" for number in range(5, MAX_EVENTS + 5)]
    assert list(pages) == [page]
