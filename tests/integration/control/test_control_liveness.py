"""When master and task set give each other up: not because of a slow link, but if the other is gone."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest
from support.control_ends import QUICK, Master, TaskSet, deaf_task_set
from support.slow_link import SlowLink

from rce.control import Left, Notify

if TYPE_CHECKING:
    from rce.control import ToMaster
    from rce.control_channel.peer import Peer

IMPATIENT = replace(QUICK, ping_interval=0.3, ping_timeout=0.5)
"""A message on the slow link takes much longer."""
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
