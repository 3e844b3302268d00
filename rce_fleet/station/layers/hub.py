"""Sends layers to the pages that show them; robots' data is asked for only while a page does."""

from __future__ import annotations

import json
from collections.abc import Iterable

from rce.aio.tasks import BackgroundTasks
from rce.ros.types import TypeRegistry
from rce_fleet.station.layers.kinds import LAYERS
from rce_fleet.station.layers.sources import LayerSource, SharedTopics
from rce_fleet.station.layers.stream import LayerStream
from rce_fleet.station.layers.transforms import RobotTransforms
from rce_fleet.station.live import Page
from rce_fleet.station.view import FleetView

MAX_TEXT = 300
"""Characters of a reason that are sent to pages."""

_Key = tuple[str, str]


class LayerHub:
    """Counts which pages show which layer of which robot.

    Args:
        source: Gives the robots' messages.
        view: Knows the robots and their poses.
        types: Knows the message types.
    """

    def __init__(self, source: LayerSource, view: FleetView, types: TypeRegistry) -> None:
        self._topics = SharedTopics(source)
        self._view = view
        self._types = types
        self._shown: dict[Page, set[_Key]] = {}
        self._streams: dict[_Key, LayerStream] = {}
        self._tasks = BackgroundTasks()

    @property
    def streams(self) -> frozenset[_Key]:
        """Robots and layers that a page shows."""
        return frozenset(self._streams)

    async def close(self) -> None:
        """End all subscriptions."""
        for key in list(self._streams):
            self._end(key)
        await self._tasks.close()
        await self._topics.close()

    def show(self, page: Page, robot: str, layers: Iterable[str]) -> None:
        """Set which layers a page shows; unknown layers, and those of unknown robots, are left out.

        Args:
            page: The page.
            robot: The robot that it shows layers of.
            layers: Names of layers.
        """
        wanted = {(robot, name) for name in layers if name in LAYERS} if self._view.knows(robot) else set()
        before = self._shown.pop(page, set())
        if wanted:
            self._shown[page] = wanted
        for key in before - wanted:
            page.drop(_frame_topic(key))
            page.drop(_status_topic(key))
        for key in wanted - before:
            stream = self._streams.get(key)
            if stream is None:
                self._start(key)
            else:
                self._repeat(page, key, stream)
        for key in before - wanted:
            if not any(key in shown for shown in self._shown.values()):
                self._end(key)

    def leave(self, page: Page) -> None:
        """Handle the end of a page."""
        self.show(page, "", ())

    def _start(self, key: _Key) -> None:
        robot, layer = key
        stream = LayerStream(
            robot,
            LAYERS[layer],
            self._types,
            self._transforms_of(robot),
            on_frame=lambda frame: self._send(key, frame),
            on_trouble=lambda text: self._tell(key, text),
        )
        self._streams[key] = stream
        stream.start(self._topics, self._tasks)

    def _end(self, key: _Key) -> None:
        self._streams.pop(key).stop()

    def _transforms_of(self, robot: str) -> RobotTransforms:
        """Return the robot's transforms, which its layers share."""
        for (other, _), stream in self._streams.items():
            if other == robot:
                return stream.transforms
        return RobotTransforms(self._types, lambda: self._view.poses.get(robot))

    def _repeat(self, page: Page, key: _Key, stream: LayerStream) -> None:
        """Send the newest frame and the newest reason to a page that shows a layer too."""
        if stream.newest:
            page.put(_frame_topic(key), stream.newest)
        if stream.trouble:
            page.put(_status_topic(key), _status(key, stream.trouble))

    def _send(self, key: _Key, frame: bytes) -> None:
        for page, shown in self._shown.items():
            if key in shown:
                page.put(_frame_topic(key), frame)

    def _tell(self, key: _Key, text: str) -> None:
        for page, shown in self._shown.items():
            if key in shown:
                page.put(_status_topic(key), _status(key, text))


def _frame_topic(key: _Key) -> str:
    return f"layer/{key[0]}/{key[1]}"


def _status_topic(key: _Key) -> str:
    return f"layer status/{key[0]}/{key[1]}"


def _status(key: _Key, text: str) -> str:
    message = {"type": "layer", "robot": key[0], "layer": key[1], "text": text[:MAX_TEXT]}
    return json.dumps(message, separators=(",", ":"))
