"""What a task set does beside the control channel with a master that keeps its connections, but is silent."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
from typing import TYPE_CHECKING

import pytest
from support.control_ends import QUICK, SECRET, Master, hello
from support.engine import until
from support.slow_link import SlowLink
from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed

from rce.aio.tasks import TaskScope
from rce.control import ContentError, NodeStateError
from rce.control.node_states import PIECE, Fetch, Found, encode
from rce.control_channel.channel import TaskSetChannel
from rce.control_channel.connections import OpenConnections
from rce.control_channel.contents import ContentClient
from rce.control_channel.dialing import Dialer, RunDialer
from rce.control_channel.node_states import NodeStateClient
from rce.control_channel.timeouts import ControlTimeouts
from rce.masters import Masters

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from websockets.asyncio.server import ServerConnection

    from rce.control import ToTaskSet

QUESTION = Fetch(process="c1", id="testUser/C", node="n")
IMPATIENT = ControlTimeouts(master_ping_interval=0.3, ping_timeout=2.0, backoff=QUICK.backoff)
PATIENT = ControlTimeouts(request=3600.0)


class Transport(asyncio.WriteTransport):
    """A connection beside the channel.

    Attributes:
        is_aborted: Whether it was ended.
    """

    is_aborted = False

    def abort(self) -> None:
        self.is_aborted = True


def channel_to(url: str, connections: OpenConnections) -> TaskSetChannel:
    async def ignore(message: ToTaskSet) -> None:
        pass

    return TaskSetChannel(url, SECRET, hello, ignore, timeouts=IMPATIENT, connections=connections)


async def test_connections_end_when_their_master_falls_silent() -> None:
    master, connections = Master(), OpenConnections()
    async with (
        master.server,
        SlowLink(f"ws://127.0.0.1:{master.server.port}").running() as link,
        TaskScope() as tasks,
    ):
        channel = channel_to(link.url, connections)
        tasks.spawn(channel.run(), name="channel")
        await channel.wait_connected()
        there, elsewhere = Transport(), Transport()
        with connections.noting(there, link.url), connections.noting(elsewhere, "ws://elsewhere"):
            link.hangs = True
            await until(lambda: there.is_aborted)
            assert not elsewhere.is_aborted


async def test_connections_to_other_masters_end_with_a_welcome() -> None:
    master, connections = Master(), OpenConnections()
    there, elsewhere = Transport(), Transport()
    async with master.server, TaskScope() as tasks:
        url = f"ws://127.0.0.1:{master.server.port}"
        with connections.noting(there, url), connections.noting(elsewhere, "ws://elsewhere"):
            channel = channel_to(url, connections)
            tasks.spawn(channel.run(), name="channel")
            await until(lambda: elsewhere.is_aborted)
            assert not there.is_aborted


@contextlib.asynccontextmanager
async def server(answer: Callable[[ServerConnection], Awaitable[None]]) -> AsyncIterator[Masters]:
    """A master whose control port answers each connection in one way."""
    async with serve(answer, "127.0.0.1", 0, ping_interval=None) as listening:
        (sock,) = listening.sockets
        yield Masters([f"ws://127.0.0.1:{sock.getsockname()[1]}"])


async def say_nothing(socket: ServerConnection) -> None:
    await socket.wait_closed()


async def test_dialed_connection_ends_with_its_master_but_no_run() -> None:
    """A run is ended only if another leadership ordered it."""
    connections = OpenConnections()
    async with server(say_nothing) as masters, asyncio.timeout(60):
        dialer = RunDialer(masters, SECRET, connections=connections)
        async with dialer.dial("run") as run, dialer.connect("/states", PIECE) as transfer:
            connections.note_silent(masters.current)
            with pytest.raises(ConnectionClosed):
                await transfer.recv()
            await run.send(b"output")


async def test_fetch_of_a_content_ends_with_its_master() -> None:
    connections, asked = OpenConnections(), asyncio.Event()

    async def hang(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        asked.set()
        await reader.read()
        writer.close()

    async with await asyncio.start_server(hang, "127.0.0.1", 0) as hanging, asyncio.timeout(60):
        masters = Masters([f"ws://127.0.0.1:{hanging.sockets[0].getsockname()[1]}"])
        client = ContentClient(masters, SECRET, PATIENT, connections=connections)
        fetching = asyncio.create_task(client.piece("0" * 64, 0))
        await asked.wait()
        connections.note_silent(masters.current)
        with pytest.raises(ContentError):
            await fetching


async def test_fetch_of_a_state_waits_for_an_answer_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of the largest snapshot begins when the master has told that it has one of that size."""
    monkeypatch.setattr("rce.control_channel.node_states.ANSWER_S", 2.0)
    async with server(say_nothing) as masters, asyncio.timeout(60):
        with pytest.raises(NodeStateError, match="no answer in time"):
            await NodeStateClient(Dialer(masters, SECRET)).fetch(QUESTION, 1 << 40)


async def test_fetched_state_takes_the_time_of_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce.control_channel.node_states.ANSWER_S", 2.0)
    state = bytes(64 * PIECE)

    async def answer(socket: ServerConnection) -> None:
        await socket.recv()
        found = Found(size=len(state), sha256=hashlib.sha256(state).hexdigest())
        await socket.send(encode(found).decode())
        await asyncio.sleep(2.5)
        for start in range(0, len(state), PIECE):
            await socket.send(state[start : start + PIECE])

    async with server(answer) as masters:
        assert await NodeStateClient(Dialer(masters, SECRET)).fetch(QUESTION, len(state)) == state
