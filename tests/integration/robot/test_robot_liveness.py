"""When the engine gives a robot's connection up: not because of a slow link, but if the robot is gone."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from dataclasses import replace
from typing import TYPE_CHECKING
from urllib.parse import urlencode, urlsplit

from support.client_types import ros_string
from support.cloud import DIGEST, running_cloud
from support.slow_link import SlowLink
from websockets.asyncio.client import connect
from websockets.frames import Opcode

from rce_robot.settings import SessionSettings

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from integration.robot.conftest import Robot
    from support.cloud import Cloud, PeerInterface

STRING = "std_msgs/String"
ROBOT = "testUser/testRobot"
QUICK = SessionSettings(ping_interval=0.3, ping_timeout=0.5, close_timeout=0.2, drain_timeout=1.0)
"""Short, so that a slow link takes much longer."""
UNWATCHED = replace(QUICK, ping_interval=None)
RATE = 400e3
QUERY = urlencode({"userID": "testUser", "robotID": "testRobot", "password": DIGEST})


@contextlib.asynccontextmanager
async def raw_robot(cloud: Cloud) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """Log a robot in that reads only what the test reads, and never answers a ping."""
    parts = urlsplit(cloud.ws_url)
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16 << 10)
    sock.setblocking(False)
    await asyncio.get_running_loop().sock_connect(sock, (parts.hostname, parts.port))
    reader, writer = await asyncio.open_connection(sock=sock, limit=16 << 10)
    writer.write(
        f"GET /?{QUERY} HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
    )
    assert b" 101 " in await reader.readuntil(b"\r\n\r\n")
    try:
        yield reader, writer
    finally:
        writer.transport.abort()


def linked(link: SlowLink) -> connect:
    """Log a robot in at the other side of a link."""
    return connect(f"{link.url}?{QUERY}", proxy=None, compression=None, max_size=None, ping_interval=None)


def fill(end: PeerInterface) -> None:
    """Send the robot more than all buffers on the way take."""
    for _ in range(40):
        end.port.send(ros_string("x" * (1 << 20)))


async def test_robot_on_slow_link_is_kept(robot_of: type[Robot]) -> None:
    """The answer to a ping waits behind a message for several times the timeout."""
    text = "x" * 2_000_000
    async with (
        running_cloud(QUICK) as cloud,
        SlowLink(cloud.ws_url, up=RATE).running() as link,
        linked(link) as robot_socket,
    ):
        end = await cloud.joined("chat", "SubscriberConverter", STRING)
        robot = robot_of(robot_socket)
        await robot.get("ST")
        await robot.say("chat", STRING, {"data": text})
        async with asyncio.timeout(60):
            assert await end.received.get() == ros_string(text)
        assert cloud.master.left == []


async def test_robot_that_reads_slowly_is_kept(robot_of: type[Robot]) -> None:
    """A ping waits behind a message for several times the timeout."""
    async with (
        running_cloud(QUICK) as cloud,
        SlowLink(cloud.ws_url, down=RATE).running() as link,
        linked(link) as robot_socket,
    ):
        end = await cloud.joined("news", "PublisherForwarder", STRING)
        await robot_of(robot_socket).get("ST")
        end.port.send(bytes(2_000_000))
        await robot_of(robot_socket).get("DM")
        async with asyncio.timeout(60):
            assert len(await robot_socket.recv()) == 32 + 2_000_000
        assert cloud.master.left == []


async def test_robot_that_vanishes_amid_data_is_lost() -> None:
    """It takes nothing more of what waits for it, so that a ping waits too."""
    async with running_cloud(QUICK) as cloud, raw_robot(cloud):
        fill(await cloud.joined("image", "PublisherForwarder", STRING))
        await cloud.master.changed.until(lambda: ROBOT in cloud.master.left)


async def test_robot_that_answers_no_ping_is_lost() -> None:
    async with running_cloud(QUICK) as cloud, raw_robot(cloud):
        await cloud.master.changed.until(lambda: ROBOT in cloud.master.left)


async def test_robot_that_only_sends_is_pinged() -> None:
    """Proxies on the way end connections in which nothing goes to the robot."""
    async with running_cloud(QUICK) as cloud, raw_robot(cloud) as (reader, writer):

        async def talk() -> None:
            while True:
                writer.write(bytes((0x80 | Opcode.PONG, 0x80, 0, 0, 0, 0)))
                await asyncio.sleep(0.02)

        talking = asyncio.create_task(talk())
        try:
            async with asyncio.timeout(60):
                for _ in range(5):  # together longer than the timeout
                    assert await reader.readexactly(2) == bytes((0x80 | Opcode.PING, 0))
        finally:
            talking.cancel()
            await asyncio.gather(talking, return_exceptions=True)
        assert cloud.master.left == []


async def test_dropped_robot_that_reads_nothing_is_gone() -> None:
    """The close frame does not wait until the robot takes what is before it."""
    async with running_cloud(UNWATCHED) as cloud, raw_robot(cloud):
        end = await cloud.joined("image", "PublisherForwarder", STRING)
        fill(end)
        await cloud.master.changed.until(lambda: cloud.master.usage is not None)
        cloud.master.drop(ROBOT, "the test ends it")
        await cloud.master.changed.until(lambda: ROBOT in cloud.master.gone)
