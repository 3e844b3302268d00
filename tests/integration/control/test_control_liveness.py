"""When master and task set give each other up: not because of a slow link, but if the other is gone."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import replace
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest
from support.control_ends import QUICK, SECRET, Master, TaskSet, deaf_task_set
from support.slow_link import SlowLink
from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed

from rce.control import Left, Notify
from rce.control_channel.dialing import Dialer
from rce.masters import Masters

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from websockets.asyncio.client import ClientConnection
    from websockets.asyncio.server import ServerConnection

    from rce.control import ToMaster
    from rce.control_channel.peer import Peer

IMPATIENT = replace(QUICK, ping_interval=0.3, master_ping_interval=0.3, ping_timeout=0.5)
"""A message on the slow link takes much longer."""
PATIENT = replace(QUICK, ping_interval=60.0, master_ping_interval=60.0, ping_timeout=60.0)
RATE = 400e3
LONG = "x" * 1_500_000


def port_of(url: str) -> int:
    port = urlsplit(url).port
    assert port is not None
    return port


async def test_a_long_message_of_the_master_passes_a_slow_link() -> None:
    master = Master(timeouts=IMPATIENT)
    async with (
        master.server,
        SlowLink(f"ws://127.0.0.1:{master.server.port}", down=RATE).running() as link,
        TaskSet(port_of(link.url), timeouts=IMPATIENT).running() as robots,
    ):
        peer, _ = await master.hellos.get()
        peer.send(Notify(id="u/r", text=LONG))
        async with asyncio.timeout(60):
            while not isinstance(told := await robots.told.get(), Notify):
                pass
        assert told.text == LONG
        assert master.story == ["hello"]


async def test_a_long_message_of_the_task_set_passes_a_slow_link() -> None:
    master = Master(timeouts=IMPATIENT)
    async with (
        master.server,
        SlowLink(f"ws://127.0.0.1:{master.server.port}", up=RATE).running() as link,
        TaskSet(port_of(link.url), timeouts=IMPATIENT).running() as robots,
    ):
        await robots.channel.wait_connected()
        robots.channel.send(Left(id="u/r", reason=LONG))
        async with asyncio.timeout(60):
            assert await master.messages.get() == Left(id="u/r", reason=LONG)
        assert master.story == ["hello"]


async def test_a_task_set_that_vanishes_amid_data_is_given_up() -> None:
    """It takes nothing more, so a ping waits behind what was sent before."""
    master = Master(timeouts=IMPATIENT)
    async with master.server, deaf_task_set(master) as peer:
        for _ in range(40):
            peer.send(Notify(id="u/r", text=LONG))
        async with asyncio.timeout(60):
            assert await master.gone.get() is peer


async def test_the_silence_of_a_task_set_is_known() -> None:
    """So the master sends no robots to one that hangs, before it gives it up."""
    master = Master(timeouts=replace(PATIENT, ping_interval=1.0))
    async with (
        master.server,
        SlowLink(f"ws://127.0.0.1:{master.server.port}").running() as link,
        TaskSet(port_of(link.url), timeouts=replace(PATIENT, master_ping_interval=0.1)).running() as robots,
    ):
        peer, _ = await master.hellos.get()
        await robots.channel.wait_connected()
        link.hangs = True
        await until(lambda: peer.silence > 2.0)
        assert robots.channel.connected
        link.hangs = False
        await until(lambda: peer.silence == 0.0)


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.02)


async def test_a_master_that_vanishes_is_given_up(caplog: pytest.LogCaptureFixture) -> None:
    """The task set dials again when nothing comes any more, also if it sends much itself."""
    caplog.set_level("INFO")
    master = Master(timeouts=IMPATIENT)
    async with (
        master.server,
        SlowLink(f"ws://127.0.0.1:{master.server.port}").running() as link,
        TaskSet(port_of(link.url), timeouts=IMPATIENT).running() as robots,
    ):
        await robots.channel.wait_connected()
        link.hangs = True
        for _ in range(40):
            robots.channel.send(Left(id="u/r", reason=LONG))
        async with asyncio.timeout(60):
            while robots.channel.connected:
                await asyncio.sleep(0.05)
        link.hangs = False
        async with asyncio.timeout(60):
            await robots.channel.wait_connected()
        assert "no sign of life" in caplog.text


class Slow(Master):
    """A master that handles no message until it may."""

    def __init__(self) -> None:
        super().__init__(timeouts=IMPATIENT)
        self.may = asyncio.Event()

    async def on_message(self, peer: Peer, message: ToMaster) -> None:
        await self.may.wait()
        await super().on_message(peer, message)


async def test_a_master_that_reads_slowly_keeps_the_task_set() -> None:
    """What it has not read yet may be a sign of life."""
    master = Slow()
    patient = replace(IMPATIENT, ping_timeout=60.0)
    async with master.server, TaskSet(master.server.port, timeouts=patient).running() as robots:
        await robots.channel.wait_connected()
        for number in range(200):
            robots.channel.send(Left(id="u/r", reason=f"{number}" + "y" * 50_000))
        await asyncio.sleep(2.5)  # longer than both times together
        master.may.set()
        async with asyncio.timeout(60):
            for _ in range(200):
                await master.messages.get()
        assert master.story == ["hello"]


async def test_master_ends_though_a_task_set_takes_nothing() -> None:
    """Pings alone would hold it for a minute."""
    master = Master(timeouts=PATIENT)
    async with asyncio.timeout(30):
        async with master.server, deaf_task_set(master) as peer:
            for _ in range(40):
                peer.send(Notify(id="u/r", text=LONG))
            await asyncio.sleep(0.2)  # until the network takes nothing more


async def test_task_set_ends_though_the_master_takes_nothing() -> None:
    """The same for the other end."""
    master = Slow()
    async with master.server, SlowLink(f"ws://127.0.0.1:{master.server.port}").running() as link:
        async with asyncio.timeout(30):
            async with TaskSet(port_of(link.url), timeouts=PATIENT).running() as robots:
                await robots.channel.wait_connected()
                link.hangs = True
                for _ in range(40):
                    robots.channel.send(Left(id="u/r", reason=LONG))
                await asyncio.sleep(0.2)
        master.may.set()


async def test_connection_beside_the_channel_ends_in_its_time() -> None:
    """What is sent to a master that takes nothing is given up when its time is over, and the close too."""
    async with deaf_server() as port:
        dialer = Dialer(Masters([f"ws://127.0.0.1:{port}"]), SECRET, PATIENT)
        async with asyncio.timeout(30):
            with pytest.raises(TimeoutError):
                await _send_for(1, dialer)


async def test_connection_beside_the_channel_notices_a_gone_master() -> None:
    """It ends without a limit of its user, unless that one allows silence."""
    async with deaf_server() as port:
        dialer = Dialer(Masters([f"ws://127.0.0.1:{port}"]), SECRET, IMPATIENT)
        async with asyncio.timeout(60), dialer.connect("/states", 1 << 20, silence=0.5) as socket:
            with pytest.raises(ConnectionClosed):
                await _send_on(socket)


async def _send_for(seconds: float, dialer: Dialer) -> None:
    async with asyncio.timeout(seconds), dialer.connect("/states", 1 << 20) as socket:
        await _send_on(socket)


async def _send_on(socket: ClientConnection) -> None:
    while True:
        await socket.send(LONG)


@contextlib.asynccontextmanager
async def deaf_server() -> AsyncIterator[int]:
    """A WebSocket server that reads nothing after the handshake; yields its port."""

    async def stay(socket: ServerConnection) -> None:
        socket.transport.pause_reading()
        try:
            await ended.wait()
        finally:
            socket.transport.abort()

    ended = asyncio.Event()
    async with serve(stay, "127.0.0.1", 0, ping_interval=None) as server:
        (sock,) = server.sockets
        try:
            yield int(sock.getsockname()[1])
        finally:
            ended.set()
