"""A client's requests that were dropped, lost or cancelled: which are repeated, and what they leave."""

from __future__ import annotations

import asyncio
import re
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from integration.client.conftest import TIMING, Engine, stall
from support.client_types import ECHO, STRING, ros_string
from support.cloud import PASSWORD, content_of, running_cloud
from support.slow_link import SlowLink

from rce.aio.backoff import Backoff
from rce.model import ConfigureComponents, ConfigureConnections
from rce.model import Connection as ConnectionSpec
from rce.protocol import MAX_ITEMS
from rce_client.connection import Connection, State
from rce_client.exceptions import NotConnectedError
from rce_robot.settings import SessionSettings

if TYPE_CHECKING:
    from integration.client.conftest import Door

    from rce.control.messages import ClientRequest


async def test_requests_that_a_busy_engine_drops_are_repeated(door: Door) -> None:
    """All interfaces of a program exist at last, and those that it removed do not."""
    async with running_cloud(SessionSettings(max_requests=4)) as cloud:
        engine = Engine(cloud, door)
        made: set[str] = set()
        gate = asyncio.Event()

        async def answer(request: ClientRequest) -> tuple[str, ...]:
            await gate.wait()
            content = content_of(request)
            assert isinstance(content, ConfigureComponents)
            made.difference_update(item.tag for item in content.remove_interfaces)
            made.update(item.interface.tag for item in content.add_interfaces)
            engine.master.changed.set()
            return ()

        engine.master.answer = answer
        async with engine.connection() as conn:
            tags = [f"say{number}" for number in range(20)]
            say = await asyncio.gather(*(conn.publisher(tag, STRING) for tag in tags))
            await engine.wait_errors(conn, "because the engine is busy")
            gate.set()
            await engine.master.changed.until(lambda: made == set(tags))
            gate.clear()
            conn.errors.clear()
            await asyncio.gather(*(one.close() for one in say[:15]))
            await engine.wait_errors(conn, "because the engine is busy")
            gate.set()
            await engine.master.changed.until(lambda: made == set(tags[15:]))


@pytest.mark.parametrize("is_repeated", [False, True])
async def test_removal_dropped_before_an_outage_is_repeated(
    door: Door, monkeypatch: pytest.MonkeyPatch, is_repeated: bool
) -> None:
    """The connection breaks before its repetition, or before that arrives."""
    monkeypatch.setattr("rce_client.repetition.PAUSES", Backoff(first=3600.0, longest=3600.0))
    async with running_cloud(SessionSettings(max_requests=2, drain_timeout=1.0)) as cloud:
        engine = Engine(cloud, door)
        gate = asyncio.Event()

        async def answer(_: ClientRequest) -> tuple[str, ...]:
            await gate.wait()
            return ()

        engine.master.answer = answer
        async with asyncio.timeout(60), engine.connection() as conn:
            await conn.create_container("c0")
            await engine.master.changed.until(lambda: len(engine.master.requests) == 1)
            for tag in ("c1", "c2"):
                await conn.create_container(tag)  # they wait in the engine, which takes nothing more now
            await conn.destroy_container("old")
            session = conn._session
            while session._unconfirmed or not session._maybe_dropped:
                await asyncio.sleep(0.01)
            engine.stop_reading()
            if is_repeated:
                await session._repeat_all()
            gate.set()
            engine.door.status = 503
            await engine.kick()
            engine.master.requests.clear()
            engine.door.status = 200
            await engine.master.changed.until(lambda: engine.master.requests)
        assert engine.master.requests[0] == ("testUser/testRobot", "DC", {"containerTag": "old"})


async def test_requests_that_were_dropped_are_told_together(
    door: Door, caplog: pytest.LogCaptureFixture
) -> None:
    """A station of a thousand robots logged hundreds of lines when it started."""
    async with running_cloud(SessionSettings(max_requests=4)) as cloud:
        engine = Engine(cloud, door)
        gate, made = asyncio.Event(), set[str]()

        async def answer(request: ClientRequest) -> tuple[str, ...]:
            await gate.wait()
            content = content_of(request)
            assert isinstance(content, ConfigureComponents)
            made.update(item.interface.tag for item in content.add_interfaces)
            engine.master.changed.set()
            return ()

        engine.master.answer = answer
        async with engine.connection() as conn:
            tags = [f"say{number}" for number in range(40)]
            await asyncio.gather(*(conn.publisher(tag, STRING) for tag in tags))
            await engine.wait_errors(conn, "requests were not carried out")
            told = [record.message for record in caplog.records if "not carried out" in record.message]
            assert len(told) == 1
            assert int(re.findall(r"\d+", told[0])[0]) > 1
            gate.set()
            await engine.master.changed.until(lambda: made == set(tags))


async def test_what_is_removed_while_away_is_removed_on_return(engine: Engine) -> None:
    async with engine.connection() as conn:
        await conn.create_container("c1")
        await conn.create_container("c2")
        await engine.master.changed.until(lambda: len(engine.master.requests) == 2)
        engine.door.status = 503
        await engine.kick()
        await conn.destroy_container("c1")
        publisher = await conn.publisher("say", STRING)
        assert not publisher.publish({"data": "into the void"})
        client = await conn.service_client("ask", ECHO)
        with pytest.raises(NotConnectedError):
            await client({"data": "x"})
        engine.master.requests.clear()
        engine.door.status = 200
        await publisher.wait_active(10)
    made = [(type_, data.get("containerTag")) for _, type_, data in engine.master.requests]
    assert made[0] == ("DC", "c1")
    assert ("CC", "c2") in made
    assert ("CC", "c1") not in made


async def test_removals_in_an_unnoticed_outage_are_repeated(engine: Engine) -> None:
    """What is removed between the loss of a connection and its detection is removed after the reconnect."""
    states: list[State] = []
    async with SlowLink(engine.cloud.ws_url).running() as link:
        engine.door.body = f'{{"url": "{link.url}"}}'
        timing = replace(TIMING, ping_interval=0.3, ping_timeout=0.3)
        conn = Connection(
            engine.door.url,
            "testUser",
            PASSWORD,
            "testRobot",
            timing=timing,
            on_state=lambda state, _: states.append(state),
        )
        async with asyncio.timeout(60), conn:
            publisher = await conn.publisher("say", STRING)
            await conn.create_container("c1")
            await conn.create_container("c2")
            await conn.add_node("c2", "n1", "Test", "a.py")
            await conn.connect("testRobot/say", "c2/hear")
            await publisher.wait_active(10)
            link.hangs = True
            await conn.disconnect("testRobot/say", "c2/hear")
            await conn.remove_node("c2", "n1")
            await conn.destroy_container("c1")
            await conn.create_container("c1")
            await conn.resize_container("other", cpu=1)
            assert State.LOST not in states
            while State.LOST not in states:
                await asyncio.sleep(0.02)
            await link.close()  # what it holds is lost
            engine.master.requests.clear()
            link.hangs = False
            await link.open()
            await engine.master.changed.until(lambda: len(engine.master.requests) >= 7)
    assert [kind for _, kind, _ in engine.master.requests] == ["CX", "CN", "DC", "RC", "CC", "CC", "CN"]
    cut, removed, *_ = (data for _, _, data in engine.master.requests)
    assert cut == {"disconnect": [{"tagA": "testRobot/say", "tagB": "c2/hear"}]}
    assert removed == {"removeNodes": [{"containerTag": "c2", "nodeTag": "n1"}]}


async def test_received_removals_are_not_repeated(engine: Engine) -> None:
    back = asyncio.Event()

    def watch(state: State, _: str) -> None:
        if state is State.RESTORED:
            back.set()

    async with asyncio.timeout(60), engine.connection(on_state=watch) as conn:
        await conn.create_container("c1")
        await conn.destroy_container("c1")
        publisher = await conn.publisher("say", STRING)
        await publisher.wait_active(10)
        engine.master.requests.clear()
        await engine.kick()
        await back.wait()
        await publisher.wait_active(10)
    assert "DC" not in [type_ for _, type_, _ in engine.master.requests]


async def test_cancelled_removal_of_many_is_sent_as_a_whole(engine: Engine) -> None:
    async with asyncio.timeout(60), engine.connection() as conn:
        await stall(engine, conn)
        pairs = tuple(ConnectionSpec(tag_a=f"a/n{number}", tag_b="b/b") for number in range(MAX_ITEMS + 1))
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.1):
                await conn.request(ConfigureConnections(disconnect=pairs))
        await engine.kick()
        requests = engine.master.requests
        await engine.master.changed.until(lambda: [kind for _, kind, _ in requests].count("CX") == 2)


async def test_requests_repeated_while_away_are_sent_once(engine: Engine) -> None:
    """Repeating them for hours does not flood the engine, and what was removed meanwhile is removed."""
    lost, back = asyncio.Event(), asyncio.Event()

    def watch(state: State, _: str) -> None:
        if state is State.LOST:
            lost.set()
        elif state is State.RESTORED:
            back.set()

    async with engine.connection(on_state=watch) as conn:
        for tag in ("c1", "c2"):
            await conn.create_container(tag)
        await conn.connect("testRobot/say", "other/hear")
        await engine.master.changed.until(lambda: len(engine.master.requests) == 3)
        engine.door.status = 503
        await engine.kick()
        async with asyncio.timeout(60):
            await lost.wait()
        engine.master.requests.clear()
        for _ in range(100):
            await conn.repeat_requests()
        await conn.destroy_container("c2")
        engine.door.status = 200
        async with asyncio.timeout(60):
            await back.wait()
        await conn.create_container("last")

        def is_last() -> bool:
            _, kind, data = engine.master.requests[-1] if engine.master.requests else ("", "", {})
            return kind == "CC" and data["containerTag"] == "last"

        await engine.master.changed.until(is_last)
        sent = [(kind, str(data)) for _, kind, data in engine.master.requests]
        assert all(sent.count(item) <= 2 for item in sent)
        assert [data for kind, data in sent if kind == "DC"] == ["{'containerTag': 'c2'}"]


async def test_a_cancelled_request_is_sent_after_the_reconnect(engine: Engine) -> None:
    async with engine.connection() as conn:
        await conn.create_container("c1")
        await stall(engine, conn)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.1):
                await conn.destroy_container("c1")
        await engine.kick()
        requests = engine.master.requests
        await engine.master.changed.until(lambda: any(type_ == "DC" for _, type_, _ in requests))
        assert conn.connected


async def test_what_is_removed_during_a_repetition_stays_removed(engine: Engine) -> None:
    """The requests before it wait to be sent."""
    async with asyncio.timeout(60), engine.connection() as conn:
        for tag in ("c1", "c2"):
            await conn.create_container(tag)
        await stall(engine, conn)
        repetition = asyncio.create_task(conn.repeat_requests())
        await asyncio.sleep(0)
        removal = asyncio.create_task(conn.destroy_container("c2"))
        await asyncio.sleep(0)
        engine.read_again()
        await asyncio.gather(repetition, removal)
        await conn.create_container("last")
        requests = engine.master.requests
        await engine.master.changed.until(lambda: requests[-1][2].get("containerTag") == "last")
        about_c2 = [kind for _, kind, data in requests if data.get("containerTag") == "c2"]
        assert about_c2[-1] == "DC"


async def test_an_interface_whose_making_was_cancelled_can_be_made(engine: Engine) -> None:
    async with engine.connection() as conn:
        making = asyncio.create_task(conn.publisher("say", STRING))
        await asyncio.sleep(0)
        making.cancel()
        with pytest.raises(asyncio.CancelledError):
            await making
        await conn.wait_active("say", 10)
        publisher = await conn.publisher("say", STRING)
        assert publisher.publish({"data": "up"})
        assert await engine.end("say").received.get() == ros_string("up")
