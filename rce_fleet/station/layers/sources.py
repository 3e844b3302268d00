"""Where the messages of layers come from, and subscriptions that last while they have listeners."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, suppress
from functools import partial
from typing import TypeAlias

from rce.aio.tasks import BackgroundTasks
from rce.ros.errors import RosError
from rce_client.exceptions import ClientError
from rce_fleet.station.layers.decoding import Payload
from rce_fleet.station.layers.frames import LayerError
from rce_fleet.station.layers.kinds import LayerTopic

RETRY_S = 3.0
"""Pause before a topic that cannot be had is asked for again."""

Take: TypeAlias = Callable[[Payload], None]
Tell: TypeAlias = Callable[[str], None]
_Key: TypeAlias = tuple[str, LayerTopic]


class LayerSource(ABC):
    """Gives the messages of robots' topics: through the engine, or in ROS graphs."""

    @abstractmethod
    def open(
        self, robot: str, topic: LayerTopic, take: Take, tell: Tell
    ) -> AbstractAsyncContextManager[None]:
        """Receive a topic of a robot while the block runs.

        Args:
            robot: The robot's ID.
            topic: The topic.
            take: Called with each serialized message; must not block.
            tell: Called with the reason while no message can come; with an empty text once it can.

        Raises:
            LayerError: The topic cannot be had now; the text says what is missing.
            ClientError: The engine cannot be reached.
            RosError: The ROS graph cannot be reached.
        """


class SharedTopics:
    """Subscribes to each topic of a robot once, while it has listeners.

    Args:
        source: Gives the messages.
    """

    def __init__(self, source: LayerSource) -> None:
        self._source = source
        self._shared: dict[_Key, _Shared] = {}
        self._tasks = BackgroundTasks()

    def __len__(self) -> int:
        return len(self._shared)

    def join(self, robot: str, topic: LayerTopic, take: Take, tell: Tell) -> Callable[[], None]:
        """Receive a topic of a robot; return a function that ends this.

        Args:
            robot: The robot's ID.
            topic: The topic.
            take: Called with each serialized message; must not block.
            tell: Called with the reason while no message can come; with an empty text once it can.
        """
        shared = self._shared.get((robot, topic))
        if shared is None:
            shared = self._shared[robot, topic] = _Shared()
            self._tasks.spawn(self._keep(robot, topic, shared), name=f"{topic.key} of {robot}")
        entry = take, tell
        shared.listeners.append(entry)
        return partial(shared.leave, entry)

    async def close(self) -> None:
        """End all subscriptions."""
        await self._tasks.close()

    async def _keep(self, robot: str, topic: LayerTopic, shared: _Shared) -> None:
        """Subscribe until no listener is left."""
        while shared.listeners:
            try:
                async with self._source.open(robot, topic, shared.take, shared.tell):
                    await shared.wait_unused()
            except (LayerError, ClientError, RosError) as error:
                shared.tell(str(error))
                with suppress(TimeoutError):
                    async with asyncio.timeout(RETRY_S):
                        await shared.wait_unused()
        del self._shared[robot, topic]


class _Shared:
    """The listeners of one topic."""

    def __init__(self) -> None:
        self.listeners: list[tuple[Take, Tell]] = []
        self._left = asyncio.Event()

    def take(self, payload: Payload) -> None:
        for take in dict.fromkeys(take for take, _ in self.listeners):
            take(payload)

    def tell(self, text: str) -> None:
        for _, tell in tuple(self.listeners):
            tell(text)

    def leave(self, entry: tuple[Take, Tell]) -> None:
        with suppress(ValueError):
            self.listeners.remove(entry)
        self._left.set()

    async def wait_unused(self) -> None:
        while self.listeners:
            self._left.clear()
            await self._left.wait()
