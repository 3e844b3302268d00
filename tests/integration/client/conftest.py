"""A cloud that makes what the client asks for, and the HTTP door in front of it."""

from __future__ import annotations

import asyncio
import gc
import json
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from ssl import SSLContext
from typing import TYPE_CHECKING, Protocol

import pytest
from support.client_types import STRING
from support.cloud import PASSWORD, Cloud, PeerInterface, content_of, running_cloud

from rce.aio.backoff import Backoff
from rce.model.requests import ConfigureComponents
from rce_client.connection import Connection, State
from rce_client.engine_transport import Timing
from rce_robot.doors.client.websocket import RobotSocket

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rce.control.messages import ClientRequest

TIMING = Timing(backoff=Backoff(first=0.01, longest=0.05, jitter=1.0), ping_interval=None, close=1.0)


class Door:
    """The master's HTTP side: answers every request with ``status`` and ``body``."""

    def __init__(self) -> None:
        self.status = 200
        self.body = ""
        self.targets: list[str] = []
        self.url = ""

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        self.targets.append(head.split()[1].decode())
        body = self.body.encode()
        writer.write(f"HTTP/1.1 {self.status} X\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body)
        await writer.drain()
        writer.close()
        await writer.wait_closed()


class OpenDoor(Protocol):
    """Opens a door; see :func:`open_door`."""

    def __call__(self, ssl: SSLContext | None = None) -> AbstractAsyncContextManager[Door]: ...


@asynccontextmanager
async def open_door(ssl: SSLContext | None = None) -> AsyncIterator[Door]:
    door = Door()
    server = await asyncio.start_server(door.serve, "127.0.0.1", 0, ssl=ssl)
    async with server:
        door.url = f"http{'s' if ssl else ''}://127.0.0.1:{server.sockets[0].getsockname()[1]}/"
        yield door


class Engine:
    """A cloud whose master wires every interface that a robot asks for."""

    def __init__(self, cloud: Cloud, door: Door) -> None:
        self.cloud = cloud
        self.master = cloud.master
        self.door = door
        self.master.answer = self._answer
        self.refuse: dict[str, str] = {}
        door.body = json.dumps({"url": cloud.ws_url})

    async def _answer(self, request: ClientRequest) -> tuple[str, ...]:
        robot = request.id.partition("/")[2]
        errors = []
        content = content_of(request)
        added = content.add_interfaces if isinstance(content, ConfigureComponents) else ()
        for item in added:
            spec = item.interface
            if spec.tag in self.refuse:
                errors.append(self.refuse[spec.tag])
            elif item.endpoint == robot and f"{robot}_{spec.tag}" not in self.cloud.ends:
                await self.cloud.wire(spec.tag, spec.type, spec.message_type, robot=robot)
        return tuple(errors)

    def end(self, tag: str) -> PeerInterface:
        return self.cloud.ends[f"testRobot_{tag}"]

    async def kick(self) -> None:
        """Break the robot's connection, and wait until the master noticed."""
        before = len(self.master.left)
        for socket in _server_sockets():
            socket.abort()
        await self.master.changed.until(lambda: len(self.master.left) > before)

    async def wait_errors(self, conn: Connection, text: str) -> None:
        """Wait until the engine has told the client of an error."""
        async with asyncio.timeout(60):
            while not any(text in error for error in conn.errors):
                await asyncio.sleep(0.01)

    def stop_reading(self) -> None:
        """Take nothing more from the robot's connection, until that is broken or read again."""
        for socket in _server_sockets():
            socket.transport.pause_reading()

    def read_again(self) -> None:
        """Take what the robot's connection has sent meanwhile."""
        for socket in _server_sockets():
            socket.transport.resume_reading()

    def connection(
        self,
        *,
        on_error: Callable[[str], None] | None = None,
        on_state: Callable[[State, str], None] | None = None,
    ) -> Connection:
        return Connection(
            self.door.url,
            "testUser",
            PASSWORD,
            "testRobot",
            timing=TIMING,
            on_error=on_error,
            on_state=on_state,
        )


async def stall(engine: Engine, conn: Connection) -> None:
    """Fill what the network takes: what is sent from now on waits in the queue of the connection."""
    say = await conn.publisher("stalled", STRING, raw=True)
    await say.wait_active(10)
    engine.stop_reading()
    say.publish(bytes(32 << 20))
    while conn._session.transport._queue:  # until it is in the socket, as far as it goes
        await asyncio.sleep(0)


def _server_sockets() -> list[RobotSocket]:
    return [item for item in gc.get_objects() if issubclass(type(item), RobotSocket)]


@pytest.fixture
async def door() -> AsyncIterator[Door]:
    async with open_door() as opened:
        yield opened


@pytest.fixture
async def engine(door: Door) -> AsyncIterator[Engine]:
    async with running_cloud() as cloud:
        yield Engine(cloud, door)


@pytest.fixture(name="open_door")
def _open_door() -> OpenDoor:
    return open_door
