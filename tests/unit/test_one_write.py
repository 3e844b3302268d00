"""A message leaves each process in one write: a second one is a system call, and wakes the receiver twice."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any, cast

import pytest
from websockets.client import ClientProtocol
from websockets.protocol import State
from websockets.uri import parse_uri

from rce.aio.queues import OverflowPolicy
from rce.link.frames import HEADER, Frame, FrameType
from rce.link.queues import Counters, OutgoingQueue
from rce.link.settings import LinkLimits, LinkTimeouts
from rce.link.socket_carrier import SocketCarrier
from rce.ros.tcpros.connection import Connection
from rce.ros.tcpros.framing import frame
from rce_client.socket import EngineSocket
from rce_robot.doors.client.websocket import RobotSocket
from rce_robot.outgoing import Outgoing

SIZES = (20, 15_000, 62_000, 120_000)
"""Below and above where the parts of a message are joined."""
ID = b"0" * 32


class CountedTransport(asyncio.Transport):
    """Counts writes, as system calls of an event loop that writes several buffers at once."""

    def __init__(self) -> None:
        super().__init__()
        self.writes: list[int] = []
        """The bytes of each."""

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.writes.append(len(data))

    def writelines(self, list_of_data: Iterable[bytes | bytearray | memoryview]) -> None:
        self.writes.append(sum(map(len, list_of_data)))

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        sock = SimpleNamespace(family=socket.AF_UNIX, fileno=lambda: -1)
        return sock if name == "socket" else default

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass

    def get_write_buffer_limits(self) -> tuple[int, int]:
        return 0, 0

    def is_closing(self) -> bool:
        return False


@pytest.fixture
def transport() -> CountedTransport:
    return CountedTransport()


@pytest.mark.parametrize("size", SIZES)
def test_a_robots_message_is_one_write(transport: CountedTransport, size: int) -> None:
    """As a text, as a text with a binary frame (a Forwarder's), and in one binary frame."""
    robot = RobotSocket.__new__(RobotSocket)
    robot.transport = transport
    body = memoryview(b"x" * size)
    robot.write(Outgoing(bytes(body)))
    robot.write(Outgoing(b'{"type":"DM"}', ((ID, body),)))
    robot.write_binary(ID, body)
    assert len(transport.writes) == 3
    assert min(transport.writes) > size


@pytest.mark.parametrize("size", SIZES)
async def test_a_links_message_is_one_write(transport: CountedTransport, size: int) -> None:
    limits = LinkLimits()
    carrier = SocketCarrier(limits, LinkTimeouts())
    carrier.connection_made(transport)
    queue = OutgoingQueue(1, Counters(), OverflowPolicy.DROP_OLDEST, max_messages=9, max_bytes=1 << 20)
    carrier.send(queue, Frame(FrameType.DATA, 1, payload=b"x" * size))
    assert transport.writes == [HEADER.size + size]


@pytest.mark.parametrize("size", SIZES)
async def test_a_ros_message_is_one_write(transport: CountedTransport, size: int) -> None:
    owner = SimpleNamespace(connection_made=lambda _: None)
    connection = Connection(cast("Any", owner), memoryview(bytearray(16)))
    connection.connection_made(transport)
    connection.write(frame(b"x" * size))
    assert transport.writes == [4 + size]


@pytest.mark.parametrize("size", SIZES)
async def test_a_clients_message_is_one_write(transport: CountedTransport, size: int) -> None:
    """As a text with a binary frame."""
    client = EngineSocket(ClientProtocol(parse_uri("ws://engine/")))
    client.protocol.state = State.OPEN
    client.connection_made(transport)
    await client.send_frames(['{"type":"DM"}', ID + b"x" * size])
    assert len(transport.writes) == 1
    assert transport.writes[0] > size
