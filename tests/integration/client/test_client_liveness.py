"""When a client gives a connection up: not because of a slow link, but if nothing is heard."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from dataclasses import replace
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest
from integration.client.conftest import TIMING
from support.client_types import STRING, ros_string
from support.cloud import PASSWORD

from rce_client.connection import Connection, State

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from integration.client.conftest import Engine

PATIENCE = replace(TIMING, ping_interval=0.5, ping_timeout=1.0)
"""Short, so that a slow link takes much longer."""
PIECE = 16 << 10


class SlowLink:
    """Passes connections on with a limited rate, in one direction or both.

    Attributes:
        hangs: Whether nothing is passed on, while the kernel still takes what comes.
    """

    def __init__(self, url: str, *, up: float = 0.0, down: float = 0.0) -> None:
        parts = urlsplit(url)
        assert parts.hostname is not None
        self._target = parts.hostname, parts.port or 80
        self._up, self._down = up, down
        self._tasks: set[asyncio.Task[None]] = set()
        self.hangs = False
        self.url = ""

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[SlowLink]:
        sock = socket.create_server(("127.0.0.1", 0))
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, PIECE)  # so that little is on the way at a time
        server = await asyncio.start_server(self._serve, sock=sock, limit=PIECE)
        self.url = f"ws://127.0.0.1:{server.sockets[0].getsockname()[1]}/"
        try:
            yield self
        finally:
            server.close()
            for task in tuple(self._tasks):
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            await server.wait_closed()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            await self._link(reader, writer)
        except asyncio.CancelledError:
            pass  # at the end of the test; asyncio reports a handler that ends so
        finally:
            self._tasks.discard(task)
            writer.transport.abort()

    async def _link(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        sock = socket.create_connection(self._target)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, PIECE)
        there, to = await asyncio.open_connection(sock=sock, limit=PIECE)
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._pass(reader, to, self._up))
                group.create_task(self._pass(there, writer, self._down))
        except* OSError:
            pass  # one of the two ended the connection
        finally:
            to.transport.abort()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, rate: float) -> None:
        while piece := await reader.read(PIECE):
            if rate:
                await asyncio.sleep(len(piece) / rate)
            while self.hangs:
                await asyncio.sleep(0.05)
            writer.write(piece)
            await writer.drain()
        raise ConnectionResetError


def connection(engine: Engine, states: list[State]) -> Connection:
    return Connection(
        engine.door.url,
        "testUser",
        PASSWORD,
        "testRobot",
        timing=PATIENCE,
        on_state=lambda state, _: states.append(state),
    )


async def test_endpoint_that_hangs_is_given_up(engine: Engine) -> None:
    """Although the kernel of its machine takes what the client goes on to send."""
    states: list[State] = []
    async with connection(engine, states) as conn:
        publisher = await conn.publisher("chat", STRING)
        await publisher.wait_active(60)
        engine.stop_reading()

        async def talk() -> None:
            while True:
                publisher.publish({"data": "hello"})
                await asyncio.sleep(0.02)

        talking = asyncio.create_task(talk())
        async with asyncio.timeout(60):
            while State.RESTORED not in states:
                await asyncio.sleep(0.02)
        talking.cancel()
        await asyncio.gather(talking, return_exceptions=True)


@pytest.mark.parametrize(("up", "down"), [(400e3, 0.0), (0.0, 400e3)])
async def test_slow_link_is_kept(engine: Engine, up: float, down: float) -> None:
    """A message takes longer than a client waits for the answer to a ping."""
    states: list[State] = []
    text = "x" * 2_000_000
    async with SlowLink(engine.cloud.ws_url, up=up, down=down).running() as link:
        engine.door.body = f'{{"url": "{link.url}"}}'
        async with connection(engine, states) as conn, asyncio.timeout(120):
            publisher = await conn.publisher("chat", STRING)
            subscriber = await conn.subscriber("news", STRING)
            await publisher.wait_active(60)
            await subscriber.wait_active(60)
            if up:
                publisher.publish({"data": text})
                assert await engine.end("chat").received.get() == ros_string(text)
            else:
                engine.end("news").port.send(ros_string(text))
                assert (await anext(aiter(subscriber)))["data"] == text
        assert State.LOST not in states


async def test_link_that_hangs_is_given_up(engine: Engine) -> None:
    """Nothing is passed on, in the middle of a large message that fills all buffers."""
    states: list[State] = []
    async with SlowLink(engine.cloud.ws_url, up=400e3).running() as link:
        engine.door.body = f'{{"url": "{link.url}"}}'
        async with connection(engine, states) as conn, asyncio.timeout(120):
            publisher = await conn.publisher("chat", STRING)
            await publisher.wait_active(60)
            publisher.publish({"data": "x" * 20_000_000})
            link.hangs = True
            while State.LOST not in states:
                await asyncio.sleep(0.02)
            link.hangs = False
