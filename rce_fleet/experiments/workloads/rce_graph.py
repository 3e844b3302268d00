"""The ROS graph by our nodes."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING, Any

from rce.ros.node import Node, Publisher, RosError, run
from rce.ros.types import Time

from .graph import CALL_S, QUEUE

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping

    from .graph import Stamp


class RceGraph:
    """A node of ours.

    Args:
        name: The node's.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._node: Node | None = None
        self._declared: list[Coroutine[Any, Any, None]] = []
        """What is made when the program runs."""
        self._tasks: set[asyncio.Task[None]] = set()

    def output(self, topic: str, kind: str) -> RceOutput:
        """Publish a topic of a type."""
        output = RceOutput()
        self._make(self._advertise(topic, kind, output))
        return output

    def take(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Call back with each message of a topic."""
        self._make(self._subscribe(topic, kind, callback))

    def provide(self, service: str, kind: str, answer: Callable[[], Mapping[str, Any]]) -> None:
        """Answer the calls of a service."""
        self._make(self._provide(service, kind, answer))

    def call(self, service: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Call a service; call back with its answer, if there is one."""
        self._make(self._call(service, kind, callback))

    def run(self, step: Callable[[], float]) -> None:
        """Call ``step`` until the program is told to stop; it returns the seconds until its next call."""
        run(self._run(step))

    async def _run(self, step: Callable[[], float]) -> None:
        async with Node(self._name, anonymous=True) as self._node:
            for work in self._declared:
                await work
            while await self._node.sleep(step()):
                pass
            for task in self._tasks:
                task.cancel()

    def _make(self, work: Coroutine[Any, Any, None]) -> None:
        if self._node is None:
            self._declared.append(work)
            return
        task = asyncio.get_running_loop().create_task(self._beside(work))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _beside(self, work: Coroutine[Any, Any, None]) -> None:
        try:
            await work
        except RosError as error:
            print(error, file=sys.stderr)  # noqa: T201

    async def _advertise(self, topic: str, kind: str, output: RceOutput) -> None:
        assert self._node is not None
        output.publisher = await self._node.advertise(topic, kind, queue_size=QUEUE)

    async def _subscribe(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        assert self._node is not None
        await self._node.subscribe(topic, kind, callback, queue_size=QUEUE)

    async def _provide(self, service: str, kind: str, answer: Callable[[], Mapping[str, Any]]) -> None:
        assert self._node is not None
        await self._node.advertise_service(service, kind, lambda _request: answer())

    async def _call(self, service: str, kind: str, callback: Callable[[Any], None]) -> None:
        assert self._node is not None
        client = self._node.service_client(service, kind, persistent=False)
        try:
            callback(await client.call({}, timeout=CALL_S))
        finally:
            await client.close()


class RceOutput:
    """A topic that the program publishes.

    Attributes:
        publisher: What it is published by; None before it is made.
    """

    def __init__(self) -> None:
        self.publisher: Publisher | None = None

    def send(self, fields: Mapping[str, Any], stamp: Stamp | None = None) -> None:
        """Publish a message with these fields, and with a header; without effect before it is made."""
        if self.publisher is None:
            return
        if stamp is None:
            self.publisher.publish(fields)
            return
        seconds, nanoseconds = divmod(stamp.ns, 1_000_000_000)
        header = {"stamp": Time(seconds, nanoseconds), "frame_id": stamp.frame}
        self.publisher.publish({"header": header, **fields})
