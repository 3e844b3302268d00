"""Topics of a client of an engine, without a ROS graph: messages cross as JSON, images as PNG.

The file that ``EXPERIMENT_CLIENT`` names is a JSON object: ``url``, ``userID``, ``password``, ``robotID``,
and ``container``, whose interfaces have the topics' names with ``_`` for each ``/``.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import uvloop

from rce_client import Connection, Publisher
from rce_robot.converters.image import ImageConverter

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from .graph import Stamp

CONFIG = "EXPERIMENT_CLIENT"
"""Environment variable with the path of the file."""
CONNECT_S = 30.0
IMAGE = "sensor_msgs/Image"


def tag_of(topic: str) -> str:
    """Return the tag of a topic's interfaces."""
    return topic.strip("/").replace("/", "_")


class ClientGraph:
    """A client that publishes."""

    def __init__(self) -> None:
        self._config: dict[str, str] = json.loads(Path(os.environ[CONFIG]).read_text())
        self._outputs: list[tuple[str, str, ClientOutput]] = []

    def output(self, topic: str, kind: str) -> ClientOutput:
        """Publish a topic of a type."""
        output = ClientOutput(kind)
        self._outputs.append((topic, kind, output))
        return output

    def take(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Refuse: such programs only publish here."""
        raise ValueError(f"{topic} of {kind} is not taken by {callback}")

    def provide(self, service: str, kind: str, answer: Callable[[], Mapping[str, Any]]) -> None:
        """Refuse: such programs only publish here."""
        raise ValueError(f"{service} of {kind} is not provided by {answer}")

    def call(self, service: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Refuse: such programs only publish here."""
        raise ValueError(f"{service} of {kind} is not called for {callback}")

    def run(self, step: Callable[[], float]) -> None:
        """Call ``step`` until the program is told to stop; it returns the seconds until its next call."""
        uvloop.run(self._run(step))

    async def _run(self, step: Callable[[], float]) -> None:
        told = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, told.set)
        config = self._config
        async with Connection(
            config["url"], config["userID"], config["password"], config["robotID"]
        ) as robot:
            for topic, kind, output in self._outputs:
                tag = tag_of(topic)
                output.publisher = await robot.publisher(tag, kind)
                await robot.connect(f"{config['robotID']}/{tag}", f"{config['container']}/{tag}")
                await output.publisher.wait_active(timeout=CONNECT_S)
            while not told.is_set():
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(told.wait(), step())


class ClientOutput:
    """A topic that the program publishes.

    Args:
        kind: Type of its messages.
    """

    def __init__(self, kind: str) -> None:
        self._converter = ImageConverter() if kind == IMAGE else None
        self.publisher: Publisher[Any] | None = None

    def send(self, fields: Mapping[str, Any], stamp: Stamp | None = None) -> None:
        """Publish a message with these fields, and with a header."""
        assert self.publisher is not None
        message = dict(fields)
        if stamp is not None:
            seconds, nanoseconds = divmod(stamp.ns, 1_000_000_000)
            time = {"secs": seconds, "nsecs": nanoseconds}
            message["header"] = {"seq": 0, "stamp": time, "frame_id": stamp.frame}
        self.publisher.publish(message if self._converter is None else self._converter.encode(message))
