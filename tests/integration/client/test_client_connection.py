"""A program's connection to the engine, over real sockets."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from support.client_types import ECHO, STRING, ros_string

from rce.link import PeerFaultError
from rce.protocol import codec
from rce_client import Serialized
from rce_client.exceptions import (
    CallError,
    CallTimeoutError,
    InterfaceError,
)

if TYPE_CHECKING:
    from integration.client.conftest import Engine


# Messages


async def test_publisher_and_subscriber(engine: Engine) -> None:
    async with engine.connection() as conn:
        publisher = await conn.publisher("say", STRING)
        subscriber = await conn.subscriber("hear", STRING)
        await publisher.wait_active(10)
        await subscriber.wait_active(10)
        assert publisher.publish({"data": "up"})
        assert await engine.end("say").received.get() == ros_string("up")
        for text in ("one", "two"):
            engine.end("hear").port.send(ros_string(text))
        received = []
        async for message in subscriber:
            received.append(message["data"])
            if len(received) == 2:
                break
        assert received == ["one", "two"]


async def test_restarted_program_gets_the_latched_message(engine: Engine) -> None:
    """A program that is started again gets the latched message."""
    async with engine.connection() as conn:
        await conn.subscriber("hear", STRING)
        await conn.wait_active("hear", 10)
        engine.end("hear").port.send(ros_string("kept"), latched=True)
    async with engine.connection() as conn:
        await conn.wait_active("hear", 10)  # what was said before has come as well
        subscriber = await conn.subscriber("hear", STRING)
        assert (await anext(aiter(subscriber)))["data"] == "kept"
        await subscriber.close()
        engine.end("hear").port.send(ros_string("too late"), latched=True)
        other = await conn.subscriber("hear", "std_msgs/Int32")
        assert not other._queue


async def test_raw_publisher_and_subscriber(engine: Engine) -> None:
    got: asyncio.Queue[Serialized] = asyncio.Queue()
    async with engine.connection() as conn:
        publisher = await conn.publisher("say", STRING, raw=True)
        await conn.subscriber("hear", STRING, got.put_nowait, raw=True)
        await conn.wait_active("say", 10)
        await conn.wait_active("hear", 10)
        publisher.publish(b"serialized")
        assert await engine.end("say").received.get() == b"serialized"
        engine.end("hear").port.send(bytes(2_000_000))
        assert bytes(await got.get()) == bytes(2_000_000)


async def test_async_callback_and_one_that_fails(engine: Engine) -> None:
    got: asyncio.Queue[str] = asyncio.Queue()

    async def callback(message: dict[str, Any]) -> None:
        await got.put(message["data"])
        if message["data"] == "bad":
            raise ValueError("bad message")

    async with engine.connection() as conn:
        subscriber = await conn.subscriber("hear", STRING, callback)
        await subscriber.wait_active(10)
        for text in ("bad", "good"):
            engine.end("hear").port.send(ros_string(text))
        assert [await got.get(), await got.get()] == ["bad", "good"]


async def test_service_client(engine: Engine) -> None:
    async def answer(payload: bytes) -> bytes:
        if payload == ros_string("fail"):
            raise ValueError("no such thing")
        if payload == ros_string("hang"):
            await asyncio.Event().wait()
        return payload

    async with engine.connection() as conn:
        client = await conn.service_client("ask", ECHO)
        await client.wait_active(10)
        engine.end("ask").answer = answer
        answers = await asyncio.gather(*(client({"data": str(number)}) for number in range(20)))
        assert [item["data"] for item in answers] == [str(number) for number in range(20)]
        with pytest.raises(CallError, match="no such thing"):
            await client({"data": "fail"})
        with pytest.raises(CallTimeoutError, match=r"0\.05"):
            await client({"data": "hang"}, timeout=0.05)
        assert not conn.errors


async def test_failed_call_is_known_from_the_text_of_an_older_engine(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An engine of the release before says in words only which call failed."""
    monkeypatch.setattr(codec, "write_report", lambda report: {"type": "ER", "data": report.text})

    async def answer(payload: bytes) -> bytes:
        raise ValueError("no such thing")

    async with engine.connection() as conn:
        client = await conn.service_client("ask", ECHO)
        await client.wait_active(10)
        engine.end("ask").answer = answer
        with pytest.raises(CallError, match="no such thing"):
            await client({"data": "fail"})
        assert not conn.errors


async def test_service_provider(engine: Engine, caplog: pytest.LogCaptureFixture) -> None:
    async def handler(request: dict[str, Any]) -> dict[str, Any]:
        if request["data"] == "fail":
            raise ValueError("robot says no")
        if request["data"] == "ask":
            raise CallError("nothing answers yet")
        return {"data": request["data"].upper()}

    async with engine.connection() as conn:
        provider = await conn.service_provider("serve", ECHO, handler)
        await provider.wait_active(10)
        port = engine.end("serve").port
        calls = [port.call(ros_string(text)) for text in ("a", "b")]
        assert await asyncio.gather(*calls) == [ros_string("A"), ros_string("B")]
        with pytest.raises(Exception, match="robot says no"):
            await port.call(ros_string("fail"))
        assert "Traceback" in caplog.text
        caplog.clear()
        with pytest.raises(Exception, match="nothing answers yet"):
            await port.call(ros_string("ask"))
        assert "service serve: nothing answers yet" in caplog.text
        assert "Traceback" not in caplog.text


async def test_an_answer_that_cannot_be_sent_fails_its_caller(engine: Engine) -> None:
    """The connection continues, too: the next call is answered."""

    def handler(request: dict[str, Any]) -> dict[str, Any]:
        return {"data": object() if request["data"] == "bad" else "good"}

    async with engine.connection() as conn:
        provider = await conn.service_provider("serve", ECHO, handler)
        await provider.wait_active(10)
        with pytest.raises(PeerFaultError, match="the answer cannot be sent"):
            await engine.end("serve").port.call(ros_string("bad"))
        assert await engine.end("serve").port.call(ros_string("x")) == ros_string("good")


async def test_an_interface_can_be_closed_and_made_again(engine: Engine) -> None:
    async with engine.connection() as conn:
        publisher = await conn.publisher("say", STRING)
        with pytest.raises(InterfaceError):
            await conn.publisher("say", STRING)
        await publisher.close()
        await conn.publisher("say", STRING)
        await conn.wait_active("say", 10)


# Requests and errors


async def test_requests_reach_the_master(engine: Engine) -> None:
    async with engine.connection() as conn:
        await conn.create_container("c1", cpu=0.5, memory=1000)
        await conn.set_parameter("c1", "speed", 1.5)
        await conn.add_interface("c1", "in", "PublisherInterface", STRING, addr="/in")
        await conn.add_node("c1", "n1", "Test", "stringEcho.py", args="a b", namespace="ns")
        await conn.connect("c1/in", "testRobot/say")
        await conn.disconnect("c1/in", "testRobot/say")
        await conn.remove_node("c1", "n1")
        await conn.remove_interface("c1", "in")
        await conn.delete_parameter("c1", "speed")
        await conn.destroy_container("c1")
        await engine.master.changed.until(lambda: len(engine.master.requests) == 10)
    types = [type_ for _, type_, _ in engine.master.requests]
    assert types == ["CC", "CN", "CN", "CN", "CX", "CX", "CN", "CN", "CN", "DC"]
    node = {"containerTag": "c1", "nodeTag": "n1", "pkg": "Test", "exe": "stringEcho.py"}
    assert engine.master.requests[3][2] == {"addNodes": [{**node, "args": "a b", "namespace": "ns"}]}


async def test_everything_made_can_be_removed_at_once(engine: Engine) -> None:
    async with engine.connection() as conn:
        await conn.create_container("c1")
        await conn.add_interface("testRobot", "say", "SubscriberConverter", STRING)
        await conn.connect("c1/in", "testRobot/say")
        await conn.remove_all()
    await engine.master.changed.until(lambda: len(engine.master.requests) == 6)
    assert [type_ for _, type_, _ in engine.master.requests[3:]] == ["CX", "CN", "DC"]


async def test_errors_reach_the_program(engine: Engine) -> None:
    errors: asyncio.Queue[str] = asyncio.Queue()
    engine.refuse["say"] = "interface say: no such class"
    async with engine.connection(on_error=errors.put_nowait) as conn:
        await conn.publisher("say", STRING)
        assert await errors.get() == "interface say: no such class"
        with pytest.raises(TimeoutError, match="no such class"):
            await conn.wait_active("say", 0.01)


# Coming in


# Losing it


# Cancelling
