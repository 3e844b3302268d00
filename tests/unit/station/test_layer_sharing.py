"""Layers are asked for once for all pages, and only while one shows them; frames are placed on the map."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
from support.layers import STATE, header, pose, transform

from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce_fleet.station.layers import sources
from rce_fleet.station.layers.frames import LayerData, LayerError, encode
from rce_fleet.station.layers.hub import LayerHub
from rce_fleet.station.layers.kinds import LAYERS, LayerTopic
from rce_fleet.station.layers.sources import LayerSource, Take, Tell
from rce_fleet.station.layers.transforms import RobotTransforms
from rce_fleet.station.live import Broadcast, Page
from rce_fleet.station.view import FleetView, Pose

TYPES = TypeRegistry(PackageIndex([]))


class MemorySource(LayerSource):
    """Topics whose messages the test gives."""

    def __init__(self) -> None:
        self.takes: dict[str, Take] = {}
        self.opened: list[str] = []
        self.refusal = ""
        self.changed = asyncio.Event()

    @asynccontextmanager
    async def open(self, robot: str, topic: LayerTopic, take: Take, tell: Tell) -> AsyncIterator[None]:
        if self.refusal:
            raise LayerError(self.refusal)
        key = f"{robot} {topic.key}"
        self.opened.append(key)
        self.takes[key] = take
        self.changed.set()
        tell("")
        try:
            yield
        finally:
            del self.takes[key]
            self.changed.set()

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(20):
            while not condition():
                self.changed.clear()
                await self.changed.wait()


def written(type_name: str, **fields: Any) -> bytes:
    kind = TYPES.message(type_name)
    return kind.serialize(kind.new(**fields))


CLOUD = written("geometry_msgs/PoseArray", header=header("map", 5.0), poses=[pose(1.0, 2.0, 0.0)])


@asynccontextmanager
async def hub_of(source: LayerSource) -> AsyncIterator[LayerHub]:
    view = FleetView()
    view.on_state(STATE)
    hub = LayerHub(source, view, TYPES)
    try:
        yield hub
    finally:
        await hub.close()


async def next_frame(page: Page) -> bytes:
    async with asyncio.timeout(20):
        while True:
            for message in await page.take():
                if isinstance(message, bytes):
                    return message


async def test_pages_get_the_same_frame_of_one_subscription() -> None:
    source, pages = MemorySource(), Broadcast()
    async with hub_of(source) as hub:
        first, second = pages.open(), pages.open()
        for page in (first, second):
            hub.show(page, "Robot1", ["particles"])
        await source.until(lambda: "Robot1 particles" in source.takes)
        source.takes["Robot1 particles"](CLOUD)
        assert await next_frame(first) is await next_frame(second)
        third = pages.open()
        hub.show(third, "Robot1", ["particles"])
        assert b'"layer":"particles"' in await next_frame(third)
        hub.leave(first)
        hub.leave(second)
        assert hub.streams == {("Robot1", "particles")}
        hub.leave(third)
        await source.until(lambda: not source.takes)
        assert source.opened == ["Robot1 particles"]


async def test_a_layer_that_is_turned_off_and_on_opens_again() -> None:
    source, page = MemorySource(), Broadcast().open()
    async with hub_of(source) as hub:
        for _ in range(5):
            hub.show(page, "Robot1", ["particles"])
            hub.show(page, "Robot1", [])
        hub.show(page, "Robot2", ["particles"])
        await source.until(lambda: list(source.takes) == ["Robot2 particles"])
        hub.show(page, "Robot1", ["particles"])
        await source.until(lambda: list(source.takes) == ["Robot1 particles"])


async def test_a_page_learns_why_a_layer_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "RETRY_S", 0.01)
    source, page = MemorySource(), Broadcast().open()
    source.refusal = "Robot1 does not offer particlecloud"
    async with hub_of(source) as hub:
        hub.show(page, "Robot1", ["particles"])
        texts = ""
        async with asyncio.timeout(20):
            while source.refusal not in texts:
                texts += "".join(map(str, await page.take()))
        source.refusal = ""
        await source.until(lambda: "Robot1 particles" in source.takes)


async def test_an_unread_page_keeps_the_newest_frame_only() -> None:
    source, pages = MemorySource(), Broadcast()
    async with hub_of(source) as hub:
        idle, read = pages.open(), pages.open()
        for page in (idle, read):
            hub.show(page, "Robot1", ["particles"])
        await source.until(lambda: "Robot1 particles" in source.takes)
        for _ in range(3):
            source.takes["Robot1 particles"](CLOUD)
            newest = await next_frame(read)
        waiting = [message for message in await idle.take() if isinstance(message, bytes)]
        assert waiting == [newest]


def make_transforms(robot_pose: Pose | None = None) -> RobotTransforms:
    made = RobotTransforms(TYPES, lambda: robot_pose)
    static = [transform("base_link", "laser", 0.0, 0.5, 0.0, 0.0)]
    made.take_static(written("tf2_msgs/TFMessage", transforms=static))
    for stamp, x in ((10.0, 1.0), (11.0, 2.0)):
        edges = [transform("map", "base_link", stamp, x, 0.0, 0.0)]
        made.take(written("tf2_msgs/TFMessage", transforms=edges))
    return made


def test_a_frame_is_placed_at_the_time_of_its_message() -> None:
    placed = make_transforms().place("laser", 10_250_000_000)
    assert placed.pose == pytest.approx((1.75, 0.0, 0.0))
    assert placed.note == ""


def test_a_message_newer_than_its_transforms_has_a_note() -> None:
    placed = make_transforms().place("/laser", 13_000_000_000)
    assert placed.pose == pytest.approx((2.5, 0.0, 0.0))
    assert placed.note == "placed by a transform that is 2.0 s older"


def test_a_scanner_that_hangs_is_seen_from_above() -> None:
    made = make_transforms()
    hanging = transform("base_link", "hanging", 0.0, 0.5, 0.0, 0.0)
    hanging["transform"]["rotation"] = {"x": 1.0, "w": 0.0}
    made.take_static(written("tf2_msgs/TFMessage", transforms=[hanging]))
    assert not made.place("laser", 0).is_upside_down
    placed = made.place("hanging", 0)
    assert placed.is_upside_down
    fields = {"angle_min": -1.0, "angle_increment": 0.1, "range_min": 0.1}
    frame = encode("Robot1", "scan", LayerData("hanging", 0, fields, b""), placed)
    shown = json.loads(frame[4 : 4 + int.from_bytes(frame[:4], "little")])
    assert {name: shown[name] for name in fields} == {**fields, "angle_min": 1.0, "angle_increment": -0.1}


def test_time_that_begins_anew_forgets_transforms() -> None:
    made = make_transforms()
    edge = transform("map", "base_link", 1.0, 7.0, 0.0, 0.0)
    made.take(written("tf2_msgs/TFMessage", transforms=[edge]))
    assert made.place("laser", 1_000_000_000).pose[0] == pytest.approx(7.5)


def test_without_transforms_the_robots_pose_stands_in() -> None:
    made = make_transforms(Pose(3.0, 4.0, 0.5))
    placed = made.place("other_laser", 0, on_robot=True)
    assert placed.pose == (3.0, 4.0, 0.5)
    assert "without transforms" in placed.note
    with pytest.raises(LayerError, match="other_odom"):
        made.place("other_odom", 0)


def test_bad_transforms_are_left_out() -> None:
    made = make_transforms()
    made.take(b"nonsense")
    edge = transform("map", "map", 12.0, float("nan"), 0.0, 0.0)
    made.take(written("tf2_msgs/TFMessage", transforms=[edge]))
    assert made.place("map", 0).pose == (0.0, 0.0, 0.0)
    assert made.place("laser", 11_000_000_000).pose[0] == pytest.approx(2.5)


def test_each_layer_has_an_interface_tag_of_its_own() -> None:
    tags = {kind.topic.interface_tag("Robot1") for kind in LAYERS.values()}
    assert len(tags) == len(LAYERS)
    assert "layer_Robot1_scan" in tags
