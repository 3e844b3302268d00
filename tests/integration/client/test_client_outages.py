"""How a client comes in, loses its connection, comes back, and leaves."""

from __future__ import annotations

import asyncio
import contextlib
import json
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from integration.client.conftest import TIMING, Engine, stall
from support.absent_masters import counted_standby, silent_master, unreachable_port
from support.client_types import ECHO, STRING, ros_string
from support.cloud import PASSWORD
from support.engine import until

from rce.aio.backoff import Backoff
from rce.aio.tasks import cancel_and_wait
from rce_client.connection import Connection, State
from rce_client.exceptions import (
    CallError,
    NotConnectedError,
    RefusedError,
)
from rce_client.reminder import Reminder

if TYPE_CHECKING:
    from integration.client.conftest import Door


async def test_the_password_itself_is_not_sent(engine: Engine) -> None:
    async with engine.connection():
        pass
    assert engine.door.targets == ["/?userID=testUser&version=20130902&auth=bearer"]


@pytest.mark.parametrize("status", [400, 401, 410, 501])
async def test_a_refusal_for_good_is_raised(door: Door, status: int) -> None:
    door.status, door.body = status, "go away"
    with pytest.raises(RefusedError, match="go away") as caught:
        async with Connection(door.url, "testUser", "x", "testRobot"):
            pass
    assert caught.value.status == status


async def test_a_wrong_password_is_raised(engine: Engine) -> None:
    with pytest.raises(RefusedError, match="Wrong user or password") as caught:
        async with Connection(engine.door.url, "testUser", "wrong", "testRobot"):
            pass
    assert caught.value.status == 401


async def test_a_robot_id_in_use_is_told_at_once_and_again(
    engine: Engine, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who has it is told, and the second client comes in when the first is gone."""
    defaults = Reminder.__init__.__defaults__
    assert defaults is not None
    monkeypatch.setattr(Reminder.__init__, "__defaults__", (0.1, *defaults[1:]))

    def told() -> list[str]:
        return [record.message for record in caplog.records if "until it is free" in record.message]

    async with asyncio.timeout(30):
        async with engine.connection():
            second = asyncio.create_task(engine.connection().__aenter__())
            while len(told()) < 3:
                await asyncio.sleep(0.02)
            assert not second.done()
        conn = await second
        await conn.__aexit__(None, None, None)
    assert "already" in told()[0]


async def test_waits_for_an_engine_that_is_not_there_yet(engine: Engine) -> None:
    engine.door.status = 503
    states: list[tuple[State, str]] = []

    def watch(state: State, words: str) -> None:
        states.append((state, words))
        if len(states) == 4:
            engine.door.status = 200

    async with engine.connection(on_state=watch):
        pass
    assert any("503" in words for _, words in states)
    assert [state for state, _ in states if state is not State.CONNECTING] == [State.CONNECTED, State.CLOSED]


async def test_a_time_limit_ends_the_waiting(door: Door) -> None:
    door.status = 503
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.2), Connection(door.url, "testUser", "x", "testRobot"):
            pass


async def test_what_the_program_raises_is_raised_as_it_is(engine: Engine) -> None:
    with pytest.raises(KeyError):
        async with engine.connection():
            raise KeyError("mine")


async def test_comes_back_and_restores(engine: Engine) -> None:
    states: list[State] = []
    changed = asyncio.Event()

    def watch(state: State, words: str) -> None:
        states.append(state)
        changed.set()

    async with engine.connection(on_state=watch) as conn:
        await conn.create_container("c1")
        publisher = await conn.publisher("say", STRING)
        client = await conn.service_client("ask", ECHO)
        await client.wait_active(10)
        await publisher.wait_active(10)
        asked = asyncio.Event()

        async def hang(payload: bytes) -> bytes:
            asked.set()
            await asyncio.Event().wait()
            return payload

        engine.end("ask").answer = hang
        call = asyncio.create_task(client({"data": "x"}))
        await asked.wait()
        engine.master.requests.clear()
        await engine.kick()
        with pytest.raises(CallError, match="connection broke"):
            await call
        assert not conn.active["say"]
        while State.RESTORED not in states:
            changed.clear()
            await changed.wait()
        await publisher.wait_active(10)
        publisher.publish({"data": "again"})
        assert await engine.end("say").received.get() == ros_string("again")
    assert [type_ for _, type_, _ in engine.master.requests] == ["CC", "CN"]
    interfaces = engine.master.requests[1][2]["addInterfaces"]
    assert [item["interfaceTag"] for item in interfaces] == ["say", "ask"]
    assert states.index(State.LOST) < states.index(State.RESTORED)


async def test_a_refusal_on_the_way_back_closes_the_connection(engine: Engine) -> None:
    async with engine.connection() as conn:
        subscriber = await conn.subscriber("hear", STRING)
        engine.door.status, engine.door.body = 410, "too old"
        await engine.kick()
        assert [message async for message in subscriber] == []
        with pytest.raises(RefusedError):
            await conn.create_container("c1")
        assert conn.state is State.CLOSED


async def test_leaving_can_be_cancelled_while_messages_wait(engine: Engine) -> None:
    conn = await engine.connection().__aenter__()
    await stall(engine, conn)
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.1):
            await conn.__aexit__(None, None, None)
    assert conn.state is State.CLOSED
    with pytest.raises(NotConnectedError):
        await conn.create_container("c1")


@pytest.mark.parametrize("fault", ["hangs", "is off"])
async def test_a_master_that_answers_nothing_is_passed_over_soon(engine: Engine, fault: str) -> None:
    """Its program hangs, or its machine is off; alone, either would have the time of ``locate``."""
    timing = replace(TIMING, locate=600.0, locate_next=1.0, connect=1.0)
    async with contextlib.AsyncExitStack() as stack:
        if fault == "hangs":
            absent, _ = await stack.enter_async_context(silent_master())
        else:
            absent = f"http://127.0.0.1:{stack.enter_context(unreachable_port())}/"
        masters = [absent, engine.door.url]
        async with (
            asyncio.timeout(60),
            Connection(masters, "testUser", PASSWORD, "testRobot", timing=timing) as conn,
        ):
            assert conn.connected


async def test_an_endpoint_whose_machine_is_off_is_passed_over(engine: Engine) -> None:
    """The master names it until it misses it, and another one then."""
    there = engine.door.body
    with unreachable_port() as port:
        engine.door.body = json.dumps({"url": f"ws://127.0.0.1:{port}/"})
        timing = replace(TIMING, connect=0.2, open=600.0)
        async with asyncio.timeout(60), asyncio.TaskGroup() as tasks:
            connection = Connection(engine.door.url, "testUser", PASSWORD, "testRobot", timing=timing)
            opening = tasks.create_task(connection.__aenter__())
            while len(engine.door.targets) < 5:
                await asyncio.sleep(0.01)
            engine.door.body = there
            await opening
            assert connection.connected
            await connection.__aexit__(None, None, None)


async def test_of_several_masters_the_first_that_answers_is_used(engine: Engine) -> None:
    nowhere = "http://127.0.0.1:1/"
    for masters in ([nowhere, engine.door.url], f"{nowhere},{engine.door.url}"):
        connection = Connection(masters, "testUser", PASSWORD, "testRobot")
        async with asyncio.timeout(30), connection:
            assert connection.connected
        await engine.cloud.master.changed.until(lambda: not engine.cloud.master.inside)


async def test_masters_are_asked_with_one_pause_for_each_round(engine: Engine) -> None:
    timing = replace(TIMING, backoff=Backoff(first=600.0, longest=600.0))
    async with counted_standby("http") as (one, ones), counted_standby("http") as (two, twos):
        absent = Connection([one, two], "testUser", PASSWORD, "testRobot", timing=timing)
        waiting = asyncio.create_task(absent.__aenter__())
        await until(lambda: twos, what="all were asked")
        await asyncio.sleep(0.3)
        await cancel_and_wait(waiting)
        assert (len(ones), len(twos)) == (1, 1)
        masters = [one, two, engine.door.url]
        async with asyncio.timeout(30), Connection(masters, "testUser", PASSWORD, "testRobot", timing=timing):
            pass
