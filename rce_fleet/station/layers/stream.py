"""One layer of one robot: takes its messages, and makes a frame for all pages at most once in a period."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from rce_fleet.station.layers.decoding import LayerDecoder, Payload
from rce_fleet.station.layers.frames import LayerData, LayerError, encode, stamp_note
from rce_fleet.station.layers.kinds import TF, TF_STATIC, LayerKind, LayerTopic

if TYPE_CHECKING:
    from rce.aio.tasks import BackgroundTasks
    from rce.ros.types import TypeRegistry
    from rce_fleet.station.layers.sources import SharedTopics
    from rce_fleet.station.layers.transforms import RobotTransforms

WAITING = "waiting for the first message of {}"
LARGE = 1 << 18
"""Messages of this size, bytes, and larger ones are read in a thread."""
PLACE_AGAIN_S = 0.5
"""Pause before a message is placed again whose transforms are missing."""
MAX_UPDATES = 1000
"""Changes of a costmap that wait; with more, the oldest are lost until the next whole one."""


class LayerStream:
    """A layer that at least one page shows.

    Args:
        robot: The robot's ID.
        kind: The layer.
        types: Knows the message types.
        transforms: The robot's transforms.
        on_frame: Called with each frame.
        on_trouble: Called with the new :attr:`trouble`.

    Attributes:
        transforms: The robot's transforms.
        newest: The newest frame; empty before the first.
        trouble: Why the newest message is not shown, or none comes; empty if all is well.
    """

    def __init__(
        self,
        robot: str,
        kind: LayerKind,
        types: TypeRegistry,
        transforms: RobotTransforms,
        *,
        on_frame: Callable[[bytes], None],
        on_trouble: Callable[[str], None],
    ) -> None:
        self.transforms = transforms
        self.newest = b""
        self.trouble = WAITING.format(kind.topic.names[0])
        self._source_trouble = ""
        self._message_trouble = self.trouble
        self._robot = robot
        self._kind = kind
        self._decoder = LayerDecoder(kind, types)
        self._on_frame = on_frame
        self._on_trouble = on_trouble
        self._stamp_ns = 0
        self._unplaced: LayerData | None = None
        """What the newest message shows, if its place on the map is not known yet."""
        self._whole: Payload | None = None
        self._updates: list[Payload] = []
        self._came = asyncio.Event()
        self._ends: list[Callable[[], None]] = []
        self._task: asyncio.Task[None] | None = None

    def start(self, topics: SharedTopics, tasks: BackgroundTasks) -> None:
        """Subscribe, and make frames in one of ``tasks`` until :meth:`stop`."""
        self._on_trouble(self.trouble)
        self._join(topics, self._kind.topic, self._take_whole)
        if self._kind.updates is not None:
            self._join(topics, self._kind.updates, self._take_update)
        if self._kind.needs_transforms:
            self._join(topics, TF, self.transforms.take)
            self._join(topics, TF_STATIC, self.transforms.take_static)
        self._task = tasks.spawn(self._run(), name=f"layer {self._kind.name} of {self._robot}")

    def stop(self) -> None:
        """End the subscriptions."""
        for end in self._ends:
            end()
        if self._task is not None:
            self._task.cancel()

    def _join(self, topics: SharedTopics, topic: LayerTopic, take: Callable[[Payload], None]) -> None:
        tell = self._take_source_trouble if topic is self._kind.topic else _ignore
        self._ends.append(topics.join(self._robot, topic, take, tell))

    def _take_whole(self, payload: Payload) -> None:
        self._whole = payload
        self._updates.clear()
        self._came.set()

    def _take_update(self, payload: Payload) -> None:
        self._updates.append(payload)
        del self._updates[:-MAX_UPDATES]
        self._came.set()

    async def _run(self) -> None:
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(None if self._unplaced is None else PLACE_AGAIN_S):
                    await self._came.wait()
            self._came.clear()
            try:
                await self._show()
            except LayerError as error:
                self._message_trouble = str(error)
                self._report()
            await asyncio.sleep(self._kind.period_s)

    async def _show(self) -> None:
        """Make a frame of the newest messages.

        Raises:
            LayerError: They cannot be shown.
        """
        whole, updates = self._whole, self._updates
        self._whole, self._updates = None, []
        if whole is not None and len(whole) >= LARGE:
            data = await asyncio.to_thread(self._read, whole, updates)
        else:
            data = self._read(whole, updates)
        data = data or self._unplaced
        if data is None:
            return
        self._unplaced = data
        if self._kind.is_on_robot:
            note = stamp_note(data.stamp_ns, self._stamp_ns, time.time())
            self._stamp_ns = data.stamp_ns
            data = replace(data, notes=(*data.notes, *filter(None, [note])))
        placement = self.transforms.place(data.frame_id, data.stamp_ns, on_robot=self._kind.is_on_robot)
        self._unplaced = None
        self.newest = encode(self._robot, self._kind.name, data, placement)
        self._message_trouble = ""
        self._report()
        self._on_frame(self.newest)

    def _read(self, whole: Payload | None, updates: list[Payload]) -> LayerData | None:
        data = None if whole is None else self._decoder.decode(whole)
        return self._decoder.update(updates) or data if updates else data

    def _take_source_trouble(self, text: str) -> None:
        self._source_trouble = text
        self._report()

    def _report(self) -> None:
        text = self._source_trouble or self._message_trouble
        if text != self.trouble:
            self.trouble = text
            self._on_trouble(text)


def _ignore(text: str) -> None:
    """Leave out the trouble of a secondary topic: the frames' notes say what is missing."""
    del text
