"""Frames of poses: what goes in comes out, and other bytes are refused."""

from __future__ import annotations

import json
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.planner_states import pose, robot, state

from rce_fleet.station.feed import Feed
from rce_fleet.station.pose_frames import PoseRow, decode_poses, encode_poses
from rce_fleet.station.view import FleetView

FLOAT = st.floats(-1e6, 1e6, width=32)
ROWS = st.lists(st.builds(PoseRow, st.integers(0, 2**32 - 1), FLOAT, FLOAT, FLOAT, FLOAT), max_size=20)


@given(ROWS, st.floats(0, 4e9))
def test_poses_survive_a_frame(rows: list[PoseRow], now: float) -> None:
    assert decode_poses(encode_poses(now, rows)) == (now, rows)


def test_a_frame_is_laid_out_as_the_page_reads_it() -> None:
    frame = encode_poses(1.5, [PoseRow(7, 1.0, 2.0, 3.0, 0.5)])
    row = "070000000000803f00000040000040400000003f"
    assert frame.hex() == "5243455001000000" + "000000000000f83f" + row


@pytest.mark.parametrize("frame", [b"", b"RCEP", b"XXXX" + bytes(12), encode_poses(0.0, []) + b"x"])
def test_other_bytes_are_refused(frame: bytes) -> None:
    with pytest.raises(ValueError, match="expected"):
        decode_poses(frame)


async def test_only_a_page_that_reads_frames_gets_them() -> None:
    """Both pages get the same poses; indices in frames are those of the robots' documents."""
    view = FleetView()
    feed = Feed(view)
    plain, compact = feed.pages.open(), feed.pages.open(compact=True)
    feed.on_change(view.on_state(state(robot("Robot1"), robot("Robot2"))))
    for page in (plain, compact):
        await page.take()
    view.on_pose("Robot2", pose(1.5, 2.5, 0.5))
    feed.on_pose("Robot2")
    feed.send_poses(0.0)
    assert [json.loads(text) for text in await plain.take()] == [
        {"type": "poses", "poses": {"Robot2": [1.5, 2.5, 0.5]}}
    ]
    (frame,) = await compact.take()
    assert isinstance(frame, bytes)
    assert decode_poses(frame)[1] == [PoseRow(1, 1.5, 2.5, 0.5)]
    late = feed.pages.open(compact=True)
    _, known, last = await late.take()
    assert [each["index"] for each in json.loads(known)["robots"]] == [0, 1]
    assert isinstance(last, bytes)
    assert [row.robot for row in decode_poses(last)[1]] == [1]


async def test_a_frame_tells_what_the_planner_heard_last() -> None:
    """A robot's age is the planner's; one that tells none is not known to the page."""
    view = FleetView()
    feed = Feed(view)
    feed.on_change(view.on_state(state(robot("Robot1"), robot("Robot2"))))
    columns = {"robots": ["Robot1", "Robot2"], "x": [1.0, 2.0], "y": [0.0, 0.0], "yaw": [0.0, 0.0]}
    page = feed.pages.open(compact=True)
    for ages, expected in (([], [-1.0, -1.0]), ([0.5, 12.0], [0.5, 12.0])):
        now = 100.0 + len(ages)
        for name in view.on_poses({**columns, "age": ages}, now):
            feed.on_pose(name)
        feed.send_poses(now)
        frame = (await page.take())[-1]
        assert isinstance(frame, bytes)
        assert [row.age for row in decode_poses(frame)[1]] == expected


async def test_ages_grow_in_frames_of_pages_that_open_later() -> None:
    """Also while the planner sends nothing any more."""
    view = FleetView()
    feed = Feed(view)
    feed.on_change(view.on_state(state(robot("Robot1"))))
    columns = {"robots": ["Robot1"], "x": [1.0], "y": [0.0], "yaw": [0.0], "age": [2.0]}
    view.on_poses(columns, time.monotonic() - 3600.0)
    ages = []
    for _ in range(2):
        frame = (await feed.pages.open(compact=True).take())[-1]
        assert isinstance(frame, bytes)
        ages += [row.age for row in decode_poses(frame)[1]]
    assert 3602.0 <= ages[0] <= ages[1] < 3800.0
