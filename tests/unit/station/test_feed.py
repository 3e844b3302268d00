"""What pages are sent: everything first, then what changed, and poses of robots that moved."""

from __future__ import annotations

import json
from typing import Any

import pytest
from support.planner_states import block, changes, pose, robot, state

from rce_fleet.station.feed import REPEAT_POSE_S, Feed
from rce_fleet.station.live import Page
from rce_fleet.station.view import FleetView


class Site:
    """A view with its feed, and a page that is open from the beginning."""

    def __init__(self) -> None:
        self.view = FleetView()
        self.feed = Feed(self.view)
        self.page = self.feed.pages.open()

    def pose(self, name: str, x: float) -> None:
        self.view.on_pose(name, pose(x, 0.0, 0.0))
        self.feed.on_pose(name)

    async def take(self, page: Page | None = None) -> list[dict[str, Any]]:
        return [json.loads(text) for text in await (page or self.page).take()]


@pytest.fixture
def site() -> Site:
    """Two robots, whose state and poses the page does not have yet."""
    made = Site()
    made.feed.on_change(made.view.on_state(state(robot("Robot1"), robot("Robot2"), blocked=[5])))
    made.pose("Robot1", 1.0)
    made.feed.send_poses(0.0)
    return made


async def test_a_page_gets_everything_first(site: Site) -> None:
    grid, known, poses = await site.take()
    assert (grid["type"], grid["rows"]) == ("map", 8)
    assert (known["type"], known["blocked"]) == ("state", [5])
    assert [robot["id"] for robot in known["robots"]] == ["Robot1", "Robot2"]
    assert (poses["type"], poses["poses"]) == ("poses", {"Robot1": [1.0, 0.0, 0.0]})


async def test_then_it_gets_what_changed(site: Site) -> None:
    _, known, _ = await site.take()
    site.feed.on_change(site.view.on_changes(changes(robot("Robot2", goal=7), freed=[5])))
    (change,) = await site.take()
    assert change["type"] == "changes"
    assert change["sequence"] == known["sequence"] + 1
    assert [(robot["id"], robot["goal"]) for robot in change["robots"]] == [("Robot2", 7)]
    assert (change["freed"], change["blocked"], change["removed"]) == ([5], [], [])
    assert "pose" not in change["robots"][0]


async def test_a_page_gets_who_blocked_cells(site: Site) -> None:
    """At first all, then those that changed."""
    await site.take()
    told = block(5, "ann", reason="spill")
    site.feed.on_change(site.view.on_changes(changes(blocks=[told]), 1000.0))
    (change,) = await site.take()
    ann = {"cell": 5, "user": "ann", "robot": "", "reason": "spill", "since": 990.0, "until": None}
    assert (change["blocks"], change["removed_blocks"], change["blocked"]) == ([ann], [], [])
    _, known, _ = await site.take(site.feed.pages.open())
    assert known["blocks"] == [ann]
    site.feed.on_change(site.view.on_changes(changes(removed_blocks=[5]), 1001.0))
    assert [change["removed_blocks"] for change in await site.take()] == [[5]]


async def test_numbers_of_a_late_page_go_on_from_its_state(site: Site) -> None:
    for goal in (7, 8):
        site.feed.on_change(site.view.on_changes(changes(robot("Robot2", goal=goal))))
    late = site.feed.pages.open()
    _, known, _ = await site.take(late)
    assert known["robots"][1]["goal"] == 8
    site.feed.on_change(site.view.on_changes(changes(removed=["Robot2"])))
    (change,) = await site.take(late)
    assert (change["sequence"], change["removed"]) == (known["sequence"] + 1, ["Robot2"])


async def test_a_state_without_news_is_not_sent(site: Site) -> None:
    await site.take()
    site.feed.on_change(site.view.on_state(state(robot("Robot1"), robot("Robot2"), blocked=[5])))
    site.feed.on_event("news", "good")
    assert [message["type"] for message in await site.take()] == ["event"]


async def test_only_poses_of_robots_that_moved_are_sent(site: Site) -> None:
    await site.take()
    site.pose("Robot1", 1.0)
    site.pose("Robot2", 2.0)
    site.feed.send_poses(0.1)
    (poses,) = await site.take()
    assert poses["poses"] == {"Robot2": [2.0, 0.0, 0.0]}


async def test_a_pose_that_stays_is_repeated_now_and_then(site: Site) -> None:
    """Pages show when a robot was heard last."""
    await site.take()
    site.pose("Robot1", 1.0)
    site.feed.send_poses(REPEAT_POSE_S)
    (poses,) = await site.take()
    assert poses["poses"] == {"Robot1": [1.0, 0.0, 0.0]}


async def test_a_pose_that_comes_before_its_robot_is_sent_with_it(site: Site) -> None:
    await site.take()
    site.pose("Robot3", 3.0)
    site.feed.send_poses(0.1)
    site.feed.on_change(site.view.on_changes(changes(robot("Robot3"))))
    site.feed.send_poses(0.2)
    change, poses = await site.take()
    assert [robot["id"] for robot in change["robots"]] == ["Robot3"]
    assert poses["poses"] == {"Robot3": [3.0, 0.0, 0.0]}


async def test_a_new_map_is_sent(site: Site) -> None:
    await site.take()
    site.feed.on_change(site.view.on_state(state(robot("Robot1"), robot("Robot2"), rows=4, blocked=[5])))
    grid, change = await site.take()
    assert (grid["type"], grid["rows"]) == ("map", 4)
    assert (change["type"], change["robots"]) == ("changes", [])


def test_a_feed_knows_whether_a_page_is_open() -> None:
    """The truth of a simulated world is received only then."""
    pages = Feed(FleetView()).pages
    assert not pages.are_open.is_set()
    first, second = pages.open(), pages.open(compact=True)
    pages.close(first)
    assert pages.are_open.is_set()
    pages.close(second)
    assert not pages.are_open.is_set()
