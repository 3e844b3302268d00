"""Faults on the control channel: silent and slow peers, handlers that fail, messages that are too large."""

from __future__ import annotations

import asyncio

import pytest
from support.control_ends import Master, TaskSet, deaf_task_set

from rce.control.exceptions import (
    UnsendableError,
)
from rce.control.messages import (
    Left,
    Notify,
)
from rce.control_channel.timeouts import MAX_TEXT, ControlTimeouts


async def test_failing_callback_ends_that_peer_only(caplog: pytest.LogCaptureFixture) -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        await master.hellos.get()
        await robots.channel.wait_connected()
        robots.channel.send(Left(id="u/r", reason="boom"))
        await master.gone.get()
        await master.hellos.get()  # it came back
        assert "RuntimeError: boom" in caplog.text


async def test_failing_handler_makes_the_task_set_dial_anew(caplog: pytest.LogCaptureFixture) -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running():
        peer, _ = await master.hellos.get()
        peer.send(Notify(id="u/r", text="boom"))
        await master.hellos.get()
        assert "RuntimeError: boom" in caplog.text


async def test_silent_peer_is_noticed() -> None:
    quick = ControlTimeouts(ping_interval=0.05, ping_timeout=0.05, close=0.05)
    master = Master(timeouts=quick)
    async with master.server, deaf_task_set(master), asyncio.timeout(60):
        await master.gone.get()


async def test_peer_that_takes_no_messages_is_cut_off(caplog: pytest.LogCaptureFixture) -> None:
    master = Master()
    async with master.server, deaf_task_set(master) as peer:
        for _ in range(9000):
            peer.send(Notify(id="u/r", text="x"))
        await master.gone.get()
        assert caplog.text.count("takes no messages; cut off") == 1


async def test_large_messages_pass() -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        reply = await robots.channel.client_request("u/r", "CN", "x" * (8 * 2**20))
        assert len(reply.errors[1]) == 8 * 2**20


async def test_a_request_that_cannot_be_written_fails_alone() -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        await robots.channel.wait_connected()
        for data in ("\ud800", "x" * (MAX_TEXT + 1), object()):
            with pytest.raises(UnsendableError):
                await robots.channel.client_request("u/r", "CN", data)
        robots.channel.send(Left(id="u/r", reason="\ud800"))
        reply = await robots.channel.client_request("u/r", "CC", 1)
        assert reply.errors == ("CC", "1")
        assert master.seen["ClientRequest"] == 1
        assert master.story == ["hello"]


async def test_a_long_sync_arrives() -> None:
    master = Master()
    async with master.server, TaskSet(master.server.port).running() as robots:
        peer, _ = await master.hellos.get()
        text = "x" * (20 << 20)
        peer.send(Notify(id="u", text=text))
        while not isinstance(told := await robots.told.get(), Notify):
            pass
        assert told.text == text
