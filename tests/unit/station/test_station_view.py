"""What the station knows of the fleet."""

from __future__ import annotations

from math import cos, pi, sin

import pytest
from support.planner_states import block, changes, pose, robot, state

from rce_fleet.station.live import MAX_CHANGES, MAX_EVENTS, Broadcast
from rce_fleet.station.view import FleetView, ViewChange


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


def test_a_state_tells_what_it_changed() -> None:
    view = FleetView()
    change = view.on_state(state(robot("Robot1"), robot("Robot2"), blocked=[1, 2], pending=[3]))
    assert change == ViewChange(
        is_new_map=True, robots=("Robot1", "Robot2"), blocked=(1, 2), pending=(3,), freed=()
    )
    change = view.on_state(state(robot("Robot1", goal=9), blocked=[1, 3]))
    assert change == ViewChange(robots=("Robot1",), removed=("Robot2",), blocked=(3,), freed=(2,))
    assert not view.on_state(state(robot("Robot1", goal=9), blocked=[1, 3]))


def test_changes_are_applied_to_robots_and_cells() -> None:
    view = FleetView()
    view.on_state(state(robot("Robot1"), robot("Robot2"), blocked=[1, 2], pending=[3]))
    view.on_pose("Robot2", pose(0, 0, 0))
    change = view.on_changes(
        changes(robot("Robot1", goal=9), robot("Robot0"), removed=["Robot2"], blocked=[3], freed=[2])
    )
    assert change == ViewChange(
        robots=("Robot0", "Robot1"), removed=("Robot2",), blocked=(3,), pending=(), freed=(2,)
    )
    assert [(known["id"], known["goal"]) for known in view.robots()] == [("Robot0", None), ("Robot1", 9)]
    assert (view.blocked(), view.pending(), view.poses) == ([1, 3], [], {})


def test_a_change_that_is_applied_again_does_no_harm() -> None:
    view = FleetView()
    view.on_state(state(robot("Robot1"), robot("Robot2"), blocked=[1, 2]))
    change = changes(robot("Robot1", goal=9), removed=["Robot2"], pending=[5], freed=[2])
    view.on_changes(change)
    known = view.state
    view.on_changes(change)
    assert view.state == known


def test_who_blocked_cells_is_followed() -> None:
    """Times are of this machine; those that differ by the way of the message are the same."""
    view = FleetView()
    cells = {"blocked": [1, 2, 3]}
    spill = block(1, "ann", reason="spill", lifetime=50.0)
    change = view.on_state(state(**cells, blocks=[spill, block(2, "Robot3", sensed=True)]), 1000.0)
    assert (change.blocks, change.removed_blocks) == ((1, 2), ())
    ann = {"cell": 1, "user": "ann", "robot": "", "reason": "spill", "since": 990.0, "until": 1050.0}
    saw = {"cell": 2, "user": "", "robot": "Robot3", "reason": "", "since": 990.0, "until": None}
    assert view.blocks() == [ann, saw]
    assert view.on_changes(changes(blocks=[block(3, "bob")], removed_blocks=[2]), 1001.0) == ViewChange(
        blocks=(3,), removed_blocks=(2,)
    )
    assert [known["cell"] for known in view.blocks()] == [1, 3]
    change = view.on_state(state(**cells, blocks=[{**spill, "age": 11.4, "lifetime": 49.2}]), 1001.0)
    assert (change.blocks, change.removed_blocks, view.blocks()) == ((), (3,), [ann])
    assert view.on_state(state(**cells)).removed_blocks == (1,), "a planner of an earlier release"


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


async def test_a_page_gets_everything_first_and_then_changes() -> None:
    pages = Broadcast(lambda: ["everything"])
    page = pages.open()
    pages.send_change("in everything already")
    assert await page.take() == ["everything"]
    pages.send_change("one")
    pages.send_change("two")
    assert await page.take() == ["one", "two"]


async def test_a_page_that_is_too_slow_gets_everything_anew() -> None:
    pages = Broadcast(lambda: ["everything"])
    slow, fast = pages.open(), pages.open()
    await slow.take()
    await fast.take()
    for number in range(MAX_CHANGES + 1):
        pages.send_change(str(number))
        assert await fast.take() == [str(number)]
    assert await slow.take() == ["everything"]
    pages.send_change("next")
    assert await slow.take() == ["next"]


async def test_a_page_that_takes_no_changes_gets_everything_each_time() -> None:
    """A page of an earlier release."""
    pages = Broadcast(lambda: ["everything"])
    page = pages.open(takes_changes=False)
    for _ in range(2):
        pages.send_change("one")
        pages.send_change("two")
        assert await page.take() == ["everything"]


async def test_a_page_that_opens_before_anything_is_known_waits() -> None:
    known: list[str] = []
    pages = Broadcast(lambda: known)
    page = pages.open()
    pages.send_event("first")
    assert await page.take() == ["first"]
    known.append("everything")
    pages.send_change("one")
    assert await page.take() == ["everything"]


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


def test_the_rotation_of_the_grid_is_a_new_map() -> None:
    view = FleetView()
    turned = {"info": {"origin": {"orientation": {"x": 0.0, "y": 0.0, "z": sin(0.25), "w": cos(0.25)}}}}
    assert not view.on_grid(turned), "no map is known yet"
    view.on_state(state())
    grid = view.map()
    assert grid is not None
    assert grid["yaw"] == pytest.approx(0.5)
    straight = {"info": {"origin": {"orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}}}
    assert view.on_grid(straight).is_new_map
    assert not view.on_grid(straight)


def test_lanes_are_part_of_the_map() -> None:
    """Planners of earlier releases tell none."""
    view, lane = FleetView(), {"name": "out", "cells": [0, 1], "one_way": True}
    view.on_state(state())
    assert (view.map() or {})["lanes"] == []
    assert view.on_state(state(lanes=[lane])).is_new_map
    assert (view.map() or {})["lanes"] == [lane]
    assert not view.on_state(state(lanes=[lane]))
