"""What waits for a robot that does not read is counted over TLS too."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import serve

from rce.guard.lobby import Lobby
from rce.guard.websocket import guarded
from rce.tls.folder import CertificateFolder
from rce.tls.gate import TlsGate
from rce.tls.identity import TlsFiles, TlsIdentity
from rce.tls.websocket import behind_gate
from rce_robot.doors.client.websocket import RobotSocket

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from websockets.asyncio.server import ServerConnection

MIB = 1 << 20
LARGE = 32 * MIB
NETWORK = 12 * MIB
"""More than the kernel's buffers of one connection take."""


@contextlib.asynccontextmanager
async def robot_over_tls(folder: Path) -> AsyncIterator[tuple[RobotSocket, ClientConnection]]:
    """Connect a robot that does not read; yields both ends."""
    made = CertificateFolder(folder)
    made.make_authority()
    made.issue("cloud", ("127.0.0.1",))
    identity = TlsIdentity(TlsFiles(made.certificate("cloud"), made.key("cloud"), made.authority))
    found: asyncio.Future[RobotSocket] = asyncio.get_running_loop().create_future()

    async def run(connection: ServerConnection) -> None:
        assert isinstance(connection, RobotSocket)
        found.set_result(connection)
        await connection.wait_closed()

    lobby = Lobby("robots", per_address=4, in_all=4)
    gate = TlsGate("robots", identity.server, lobby)
    async with (
        serve(
            run,
            "127.0.0.1",
            0,
            create_connection=behind_gate(guarded(RobotSocket, lobby), gate),
            compression=None,
            ping_interval=None,
            close_timeout=60,
        ) as server,
        connect(
            f"wss://127.0.0.1:{server.sockets[0].getsockname()[1]}",
            ssl=identity.client(),
            compression=None,
            ping_interval=None,
            max_size=None,
            proxy=None,
        ) as robot,
    ):
        async with asyncio.timeout(60):
            socket = await found
        robot.transport.pause_reading()
        yield socket, robot
    await gate.close()


async def until_settled(socket: RobotSocket) -> int:
    """Wait until the network takes nothing more; return what is held."""
    held = -1
    while held != socket.held:
        held = socket.held
        await asyncio.sleep(0.3)
    return held


async def test_all_that_waits_is_counted(tmp_path: Path) -> None:
    """Also after the robot has read a part, which makes the transport encrypt more."""
    async with robot_over_tls(tmp_path) as (socket, robot):
        socket.write_binary(b"head", bytes(LARGE))
        assert not socket.writable
        assert await until_settled(socket) > LARGE - NETWORK
        before = socket.held
        robot.transport.resume_reading()
        async with asyncio.timeout(60):
            while socket.held == before:
                await asyncio.sleep(0)
        robot.transport.pause_reading()
        held = await until_settled(socket)
        assert held + len(robot.protocol.reader.buffer) > LARGE - NETWORK
        robot.transport.resume_reading()
        async with asyncio.timeout(60):
            assert await robot.recv() == b"head" + bytes(LARGE)
        assert socket.held == 0
        assert socket.writable


async def test_frames_wait_behind_a_large_one(tmp_path: Path) -> None:
    """An answer to a ping and the close come whole and in order."""
    async with robot_over_tls(tmp_path) as (socket, robot):
        socket.write_binary(b"", bytes(LARGE))
        pong = await robot.ping()
        robot.transport.resume_reading()
        async with asyncio.timeout(60):
            assert await robot.recv() == bytes(LARGE)
            await pong
        robot.transport.pause_reading()
        socket.write_binary(b"", bytes(LARGE))
        closing = asyncio.create_task(socket.close(reason="the end"))
        await until_settled(socket)
        robot.transport.resume_reading()
        async with asyncio.timeout(60):
            assert await robot.recv() == bytes(LARGE)
            await closing
            await robot.wait_closed()
        assert robot.close_reason == "the end"


async def test_abort_drops_what_waits(tmp_path: Path) -> None:
    async with robot_over_tls(tmp_path) as (socket, _):
        socket.write_binary(b"", bytes(LARGE))
        socket.abort()
        async with asyncio.timeout(60):
            await socket.wait_closed()
        assert socket.held == 0
