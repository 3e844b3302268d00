"""Faults of a node's program, and of other nodes' messages, end nothing but what they belong to."""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from typing import Any

import pytest
from support.ros_nodes import MakeNode

from rce.ros.core import Core
from rce.ros.errors import NodeClosedError, ServiceFaultError
from rce.ros.node import Node, TimerEvent
from rce.ros.types import Message, TypeRegistry

STRING = "std_msgs/String"
TRIGGER = "std_srvs/Trigger"


async def cancelled_task() -> None:
    """Wait for a task that was cancelled, as a program does that replaces its work."""
    work = asyncio.create_task(asyncio.sleep(3600))
    work.cancel()
    await work


async def test_callback_awaiting_a_cancelled_task_gets_later_messages(
    make_node: MakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    async with make_node("a") as a, make_node("b") as b:
        got: asyncio.Queue[str] = asyncio.Queue()

        async def take(message: Message) -> None:
            if message.data == "bad":
                await cancelled_task()
            got.put_nowait(message.data)

        await b.subscribe("t", STRING, take)
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        publisher.publish(data="bad")
        publisher.publish(data="good")
        assert await asyncio.wait_for(got.get(), 10) == "good"
    assert "the callback of /t failed" in caplog.text


async def test_callback_at_work_while_its_node_leaves_is_no_fault(
    make_node: MakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    """What it still wants to publish then goes nowhere; a program need not foresee that."""
    refused: list[NodeClosedError] = []
    async with make_node("a") as a:
        source = await a.advertise("in", STRING)
        async with make_node("b") as b:
            output = await b.advertise("out", STRING)
            at_work = asyncio.Event()

            async def take(message: Message) -> None:
                at_work.set()
                while True:
                    try:
                        output.publish(message)
                    except NodeClosedError as error:
                        refused.append(error)
                        raise
                    await asyncio.sleep(0)

            await b.subscribe("in", STRING, take)
            await source.wait_for_subscribers(timeout=10)
            source.publish(data="work")
            await asyncio.wait_for(at_work.wait(), 10)
    assert refused
    assert "failed" not in caplog.text


async def test_handler_awaiting_a_cancelled_task_answers_with_an_error(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        calls: list[Message] = []

        async def trigger(request: Message) -> dict[str, Any]:
            calls.append(request)
            if len(calls) == 1:
                await cancelled_task()
            return {"success": True}

        await a.advertise_service("go", TRIGGER, trigger)
        client = b.service_client("go", TRIGGER)
        with pytest.raises(ServiceFaultError, match="CancelledError"):
            await client.call({}, timeout=10)
        assert (await client.call({}, timeout=10)).success


@pytest.mark.parametrize("is_async", [True, False])
@pytest.mark.parametrize("kind", [ServiceFaultError, ValueError])
async def test_error_text_that_utf8_cannot_hold_is_escaped(
    make_node: MakeNode, monkeypatch: pytest.MonkeyPatch, is_async: bool, kind: type[Exception]
) -> None:
    """As the name of a file that was made elsewhere; the node continues."""
    # What pytest keeps of a log cannot be sent to its main process.
    monkeypatch.setattr(logging.getLogger("rce.ros.node.service"), "disabled", True)

    text = "no map caf\udce9"
    error = ServiceFaultError("/go", text) if kind is ServiceFaultError else kind(text)

    def fail(request: Message) -> dict[str, Any]:
        raise error

    async def fail_later(request: Message) -> dict[str, Any]:
        raise error

    async with make_node("a") as a, make_node("b") as b:
        await a.advertise_service("go", TRIGGER, fail_later if is_async else fail)
        for _ in range(2):
            with pytest.raises(ServiceFaultError, match=r"no map caf\\udce9"):
                await b.service_client("go", TRIGGER).call({}, timeout=10)
        assert not a.is_shutdown


@pytest.mark.parametrize("wait", ["service", "subscribers", "publishers"])
async def test_waiting_for_others_ends_when_the_node_is_told_to_stop(make_node: MakeNode, wait: str) -> None:
    """Else a program that is interrupted meanwhile would have to be killed, and stay registered."""
    async with make_node("a") as a, asyncio.timeout(10):
        publisher, subscriber = await a.advertise("t", STRING), await a.subscribe("u", STRING)
        waits = {
            "service": lambda: a.wait_for_service("s"),
            "subscribers": publisher.wait_for_subscribers,
            "publishers": subscriber.wait_for_publishers,
        }
        waiting = asyncio.ensure_future(waits[wait]())
        await asyncio.sleep(0.05)
        a.shutdown("test")
        for refused in (waiting, waits[wait]()):
            with pytest.raises(NodeClosedError, match="node /a was told to stop"):
                await refused


async def test_timer_awaiting_a_cancelled_task_calls_again(make_node: MakeNode) -> None:
    async with make_node("a") as a:
        calls: asyncio.Queue[TimerEvent] = asyncio.Queue()

        async def call(event: TimerEvent) -> None:
            calls.put_nowait(event)
            await cancelled_task()

        a.timer(0.01, call)
        async with asyncio.timeout(10):
            await calls.get()
            await calls.get()


@pytest.mark.parametrize("intra_process", [False, True])
async def test_failing_on_subscriber_callback_connects_once(
    core: Core, intra_process: bool, caplog: pytest.LogCaptureFixture
) -> None:
    def fail() -> None:
        raise RuntimeError("broken callback")

    make = partial(Node, argv=[], master_uri=core.uri, intra_process=intra_process)
    async with make("a") as a, make("b") as b:
        failing, other = await a.advertise("t", STRING), await a.advertise("t", STRING)
        told = asyncio.Event()
        failing.on_subscriber, other.on_subscriber = fail, told.set
        subscriber = await b.subscribe("t", STRING)
        await subscriber.wait_for_publishers(timeout=10)
        await asyncio.wait_for(told.wait(), 10)
        for data in ("one", "two"):
            failing.publish(data=data)
        assert [(await asyncio.wait_for(anext(subscriber), 10)).data for _ in range(2)] == ["one", "two"]
        assert failing.connections == 1
        assert not b.is_shutdown
    assert "the on_subscriber callback of /t failed" in caplog.text


@pytest.mark.parametrize("intra_process", [False, True])
async def test_iteration_leaves_out_what_is_not_a_message(
    core: Core, intra_process: bool, caplog: pytest.LogCaptureFixture
) -> None:
    make = partial(Node, argv=[], master_uri=core.uri, intra_process=intra_process)
    async with make("a") as a, make("b") as b:
        subscriber = await b.subscribe("t", STRING)
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        publisher.publish_serialized(b"\xff\xff\0\0x")
        publisher.publish(data="good")
        assert (await asyncio.wait_for(anext(subscriber), 10)).data == "good"
    assert "a message of /t is left out: data: the message ends after" in caplog.text


async def test_bad_object_keeps_no_other_from_local_subscribers(
    core: Core, caplog: pytest.LogCaptureFixture
) -> None:
    """Objects are written only for those who take bytes, long after the call that published them."""
    make = partial(Node, argv=[], master_uri=core.uri, types=TypeRegistry())
    async with make("a") as a, make("b") as b:
        raw: asyncio.Queue[bytes] = asyncio.Queue()
        objects: asyncio.Queue[Message] = asyncio.Queue()
        await b.subscribe_serialized("t", STRING, lambda payload, _: raw.put_nowait(payload))
        await b.subscribe("t", STRING, objects.put_nowait)
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        for data in (5, "one", "two"):
            publisher.publish(publisher.type.new(data=data))
        async with asyncio.timeout(10):
            assert [await raw.get(), await raw.get()] == [b"\x03\0\0\0one", b"\x03\0\0\0two"]
            assert [(await objects.get()).data for _ in range(3)] == [5, "one", "two"]
    assert "a message of /t cannot be written: data: 5 is not a string" in caplog.text


async def test_local_echo_leaves_time_for_others(core: Core) -> None:
    async with Node("a", argv=[], master_uri=core.uri) as a:
        publisher = await a.advertise("t", STRING)
        turns = 0

        def echo(message: Message) -> None:
            nonlocal turns
            turns += 1
            if turns < 100_000:  # so that a failure ends
                publisher.publish(message)

        subscriber = await a.subscribe("t", STRING, echo)
        await publisher.wait_for_subscribers(timeout=10)
        publisher.publish(publisher.type.new(data="again"))
        while not turns:
            await asyncio.sleep(0)
        await subscriber.close()
        assert turns < 1000


async def test_failing_parameter_callback_keeps_the_node_registered(
    make_node: MakeNode, core: Core, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(name: str, value: object) -> None:
        raise RuntimeError(f"{name} is {value}")

    core.set_param("/p", 1)
    async with make_node("a") as a:
        told: asyncio.Queue[object] = asyncio.Queue()
        await a.watch_param("/p", fail)
        await a.watch_param("/p", lambda _, value: told.put_nowait(value))
        async with make_node("b") as b:
            await b.set_param("/p", 2)
        assert await asyncio.wait_for(told.get(), 10) == 2
    assert "the callback of parameter /p failed" in caplog.text
    assert not [record for record in caplog.records if record.levelno >= logging.CRITICAL]


async def test_callable_object_with_a_coroutine_is_awaited(make_node: MakeNode) -> None:
    class Listener:
        def __init__(self) -> None:
            self.got: asyncio.Queue[str] = asyncio.Queue()

        async def __call__(self, message: Message) -> None:
            self.got.put_nowait(message.data)

    async with make_node("a") as a, make_node("b") as b:
        listener = Listener()
        await b.subscribe("t", STRING, listener)
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        publisher.publish(data="hello")
        assert await asyncio.wait_for(listener.got.get(), 10) == "hello"


async def test_function_that_returns_a_coroutine_is_reported(
    make_node: MakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    async def take(_: Message) -> None:
        raise AssertionError("nothing awaits it")

    async with make_node("a") as a, make_node("b") as b:
        await b.subscribe("t", STRING, lambda message: take(message))  # noqa: PLW0108 - the mistake
        publisher = await a.advertise("t", STRING)
        after = await b.subscribe("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        publisher.publish(data="hello")
        await asyncio.wait_for(anext(after), 10)
    assert "give the coroutine function itself" in caplog.text
