"""A cloud in a process, and a raw WebSocket client."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import urlencode

import pytest
from support.cloud import DIGEST, Cloud, running_cloud
from websockets.asyncio.client import connect

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from websockets.asyncio.client import ClientConnection
    from websockets.typing import Origin


class Robot:
    """A robot by hand: sends JSON, waits for messages of a type."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self._kept: list[dict[str, Any]] = []

    async def send(self, type_: str, data: object) -> None:
        await self.socket.send(json.dumps({"type": type_, "data": data}))

    async def say(self, tag: str, cls: str, msg: object, msg_id: str = "nil", key: str = "msg") -> None:
        await self.send("DM", {"iTag": tag, "type": cls, "msgID": msg_id, key: msg})

    async def get(self, type_: str) -> Any:
        """Return the data of the next message of a type; others are kept."""
        for message in self._kept:
            if message["type"] == type_:
                self._kept.remove(message)
                return message["data"]
        async with asyncio.timeout(60):
            while True:
                frame = await self.socket.recv()
                assert isinstance(frame, str)
                message = json.loads(frame)
                if message["type"] == type_:
                    return message["data"]
                self._kept.append(message)

    async def binary(self) -> bytes:
        async with asyncio.timeout(60):
            frame = await self.socket.recv()
        assert isinstance(frame, bytes)
        return frame


class Dial(Protocol):
    """Connects a robot to a cloud; see :func:`dial`."""

    def __call__(
        self, cloud: Cloud, robot: str = ..., password: str = ..., origin: Origin | None = ...
    ) -> connect: ...


def dial(
    cloud: Cloud, robot: str = "testRobot", password: str = DIGEST, origin: Origin | None = None
) -> connect:
    query = urlencode({"userID": "testUser", "robotID": robot, "password": password})
    return connect(f"{cloud.ws_url}?{query}", proxy=None, compression=None, origin=origin)


@pytest.fixture
async def cloud() -> AsyncIterator[Cloud]:
    async with running_cloud() as running:
        yield running


@pytest.fixture
async def robot(cloud: Cloud) -> AsyncIterator[Robot]:
    async with dial(cloud) as socket:
        yield Robot(socket)


@pytest.fixture(name="dial")
def _dial() -> Dial:
    return dial


@pytest.fixture
def robot_of() -> type[Robot]:
    return Robot


@pytest.fixture
def connect_to() -> Callable[[str], connect]:
    return lambda url: connect(url, proxy=None)
