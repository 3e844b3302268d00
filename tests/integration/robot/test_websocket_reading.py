"""However a robot's bytes are cut, its messages come out as the library alone would read them."""

from __future__ import annotations

import contextlib
import random
from typing import TYPE_CHECKING

import pytest
from websockets.asyncio.client import connect
from websockets.asyncio.server import serve
from websockets.frames import Frame, Opcode

from rce.guard.lobby import Lobby
from rce.guard.loop_share import LoopShare
from rce.guard.websocket import guarded
from rce_robot.doors.client.websocket import RobotSocket

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request

Message = tuple[str, bytes]


class Recorder:
    """Takes what a robot's socket tells of."""

    def __init__(self) -> None:
        self.messages: list[Message] = []

    def on_text(self, text: bytes) -> Iterator[None] | None:
        self.messages.append(("text", text))
        return None

    def on_binary(self, data: bytes) -> None:
        self.messages.append(("binary", data))

    def on_part(self) -> None:
        pass

    def on_writable(self) -> None:
        pass

    def on_lost(self, reason: str) -> None:
        pass


@contextlib.asynccontextmanager
async def robot_socket(max_size: int = 1 << 20) -> AsyncIterator[tuple[RobotSocket, Recorder]]:
    """Connect a robot; yields the engine's end and what it told of."""
    recorder = Recorder()
    found: list[RobotSocket] = []

    def admit(connection: ServerConnection, _: Request) -> None:
        assert isinstance(connection, RobotSocket)
        connection.receiver = recorder
        connection.share_loop(LoopShare(slice_s=60.0), "user")
        found.append(connection)

    async def run(connection: ServerConnection) -> None:
        await connection.wait_closed()

    lobby = Lobby("robots", per_address=4, in_all=4)
    async with (
        serve(
            run,
            "127.0.0.1",
            0,
            process_request=admit,
            create_connection=guarded(RobotSocket, lobby),
            compression=None,
            max_size=max_size,
        ) as server,
        connect(f"ws://127.0.0.1:{server.sockets[0].getsockname()[1]}", compression=None),
    ):
        yield found[0], recorder


def closed_with(socket: RobotSocket) -> int:
    """Return the code with which the engine closed a connection."""
    assert socket.protocol.close_sent is not None
    return socket.protocol.close_sent.code


def message_frames(rng: random.Random, sizes: list[int]) -> tuple[list[Frame], Message]:
    """Make a message, in one frame or in several with pings between them."""
    size = rng.choice(sizes)
    payload = rng.randbytes(size)
    opcode, kind = rng.choice([(Opcode.TEXT, "text"), (Opcode.BINARY, "binary")])
    if rng.random() < 0.7:
        return [Frame(opcode, payload)], (kind, payload)
    cut = rng.randint(0, size)
    ping = Frame(Opcode.PING, b"?")
    return [Frame(opcode, payload[:cut], fin=False), ping, Frame(Opcode.CONT, payload[cut:])], (kind, payload)


@pytest.mark.parametrize(
    ("longest", "sizes"),
    [
        (7, [0, 5, 125, 126, 300]),
        (5000, [0, 5, 125, 126, 4000, 65_535, 66_000]),
        (300_000, [5, 4000, 65_535, 66_000]),
    ],
)
@pytest.mark.parametrize("seed", range(4))
async def test_messages_survive_any_cut(seed: int, longest: int, sizes: list[int]) -> None:
    rng = random.Random(seed)
    made = [message_frames(rng, sizes) for _ in range(30)]
    data = b"".join(frame.serialize(mask=True) for frames, _ in made for frame in frames)
    async with robot_socket() as (socket, recorder):
        while data:
            size = rng.randint(1, longest)
            socket.data_received(data[:size])
            data = data[size:]
        assert recorder.messages == [message for _, message in made]
        assert socket.held == 0


async def test_whole_messages_pass_by_the_librarys_parser() -> None:
    frames = b"".join(Frame(Opcode.BINARY, bytes([number])).serialize(mask=True) for number in range(100))
    async with robot_socket() as (socket, recorder):
        parsed: list[bytes] = []
        socket.protocol.receive_data = parsed.append  # type: ignore[method-assign, assignment]  # counts
        socket.data_received(frames)
        assert recorder.messages == [("binary", bytes([number])) for number in range(100)]
        assert not parsed


async def test_a_message_over_the_limit_closes_the_connection() -> None:
    async with robot_socket(max_size=1000) as (socket, recorder):
        socket.data_received(Frame(Opcode.BINARY, bytes(1000)).serialize(mask=True))
        socket.data_received(Frame(Opcode.BINARY, bytes(1001)).serialize(mask=True))
        await socket.wait_closed()
        assert [len(data) for _, data in recorder.messages] == [1000]
        assert closed_with(socket) == 1009


async def test_a_message_within_a_fragmented_one_closes_the_connection() -> None:
    async with robot_socket() as (socket, recorder):
        socket.data_received(Frame(Opcode.TEXT, b"a", fin=False).serialize(mask=True))
        socket.data_received(Frame(Opcode.TEXT, b"b").serialize(mask=True))
        await socket.wait_closed()
        assert not recorder.messages
        assert closed_with(socket) == 1002


async def test_nothing_is_read_after_the_robots_farewell() -> None:
    async with robot_socket() as (socket, recorder):
        farewell = Frame(Opcode.CLOSE, b"\x03\xe8").serialize(mask=True)
        socket.data_received(farewell + Frame(Opcode.BINARY, b"late").serialize(mask=True))
        socket.data_received(Frame(Opcode.BINARY, b"later").serialize(mask=True))
        await socket.wait_closed()
        assert not recorder.messages
