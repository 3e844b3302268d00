"""Interfaces of a program that makes mistakes: nothing else ends with them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, cast

import pytest
from support.client_types import ECHO, STRING

from rce.protocol import DataMessage
from rce_client.services import ServiceProvider
from rce_client.topics import Publisher, Subscriber

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from rce.protocol import Frame
    from rce_client.interfaces import InterfaceOwner


class Owner:
    """A connection that notes what is sent; the interface is joined with a peer when the test says so."""

    knows_sources = True
    takes_single_frames = True

    def __init__(self) -> None:
        self.active = False
        self.sent: list[str | None] = []
        """The sources of the messages, empty for a statement about all sources."""
        self.answers: list[Frame] = []

    def is_active(self, tag: str) -> bool:
        assert tag == "say"
        return self.active

    def post_data(
        self, tag: str, frames: Sequence[Frame], key: str | None = None, queue_size: int | None = None
    ) -> bool:
        assert tag == "say"
        assert frames
        self.sent.append(key)
        return True

    def post_control(self, frames: Sequence[Frame]) -> bool:
        self.answers += frames
        return True

    def spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        return asyncio.create_task(work)


async def some_steps() -> None:
    """Let tasks run until they wait for something."""
    for _ in range(20):
        await asyncio.sleep(0)


async def a_cancelled_task() -> None:
    """Wait for another task that was cancelled."""
    task = asyncio.create_task(asyncio.sleep(0))
    task.cancel()
    await task


@pytest.fixture
def owner() -> Owner:
    return Owner()


@pytest.fixture
def publisher(owner: Owner) -> Publisher[Any]:
    return Publisher[Any](cast("InterfaceOwner", owner), "say", STRING, raw=False)


@pytest.mark.parametrize("active", [False, True])
def test_latched_message_that_cannot_be_sent_is_not_kept(
    owner: Owner, publisher: Publisher[Any], *, active: bool
) -> None:
    """The program learns it at once, not when the interface is connected."""
    owner.active = active
    publisher.publish({"data": "map"}, latch="1")
    with pytest.raises(TypeError):
        publisher.publish({"data": object()}, latch="1")
    with pytest.raises(TypeError):
        publisher.publish({"data": object()}, latch="2")
    owner.sent.clear()
    publisher.on_active()
    assert owner.sent == ["1", ""]


def test_latched_message_that_was_changed_is_left_out(
    owner: Owner, publisher: Publisher[Any], caplog: pytest.LogCaptureFixture
) -> None:
    """The others are sent again, and the log names the interface."""
    message: dict[str, object] = {"data": "pose"}
    publisher.publish(message, latch="1")
    publisher.publish({"data": "map"}, latch="2")
    message["data"] = object()
    publisher.on_active()
    assert owner.sent == ["2", ""]
    assert "say" in caplog.text


@pytest.mark.parametrize("happen", [Publisher.on_active, Publisher.on_inactive, Publisher.on_lost])
def test_exceptions_of_demand_callbacks_are_logged(
    publisher: Publisher[Any], happen: Callable[[Publisher[Any]], None], caplog: pytest.LogCaptureFixture
) -> None:
    def fail(needed: bool) -> None:
        raise ValueError(f"camera {needed}")

    publisher.watch_demand(fail)
    happen(publisher)
    assert "ValueError: camera" in caplog.text


def test_exceptions_of_latch_listeners_are_logged(owner: Owner, caplog: pytest.LogCaptureFixture) -> None:
    class Listener:
        def received_latched(self, message: object, source: str) -> None:
            raise AssertionError

        def keep_latched(self, sources: Sequence[str]) -> None:
            raise ValueError(f"kept {sources}")

    subscriber = Subscriber[Any](
        cast("InterfaceOwner", owner),
        "hear",
        STRING,
        raw=False,
        callback=print,
        queue_size=1,
        latches=Listener(),
    )
    subscriber.keep_latched(("1",))
    assert "ValueError: kept" in caplog.text


async def test_callback_that_waits_for_a_cancelled_task_fails(
    owner: Owner, caplog: pytest.LogCaptureFixture
) -> None:
    """The subscriber gets the next message, and ends when it is closed."""
    got = list[object]()

    async def callback(message: object) -> None:
        if message == "first":
            await a_cancelled_task()
        got.append(message)

    subscriber = Subscriber[Any](
        cast("InterfaceOwner", owner), "hear", STRING, raw=False, callback=callback, queue_size=2
    )
    for text in ("first", "second"):
        subscriber.deliver(DataMessage("hear", STRING, text))
    await some_steps()
    assert got == ["second"]
    assert "callback of subscriber hear" in caplog.text
    subscriber.on_closed()
    assert subscriber._pump is not None
    await asyncio.wait([subscriber._pump])
    assert subscriber._pump.cancelled()


async def test_handler_that_waits_for_a_cancelled_task_is_answered(owner: Owner) -> None:
    """An answer comes at once; a call of a provider that is closed gets none."""
    waits = asyncio.Event()

    async def handler(request: object) -> object:
        await (a_cancelled_task() if request == "first" else waits.wait())
        return request

    provider = ServiceProvider[Any](
        cast("InterfaceOwner", owner), "serve", ECHO, handler, raw=False, max_calls=2
    )
    for text in ("first", "second"):
        provider.deliver(DataMessage("serve", ECHO, text, text))
    await some_steps()
    provider.on_closed()
    await some_steps()
    (answer,) = owner.answers
    assert '"msgID":"first","msg":"CancelledError' in str(answer)


@pytest.mark.parametrize("text", [object(), "\ud800"])
async def test_answer_that_cannot_be_written_fails_its_caller(owner: Owner, text: object) -> None:
    provider = ServiceProvider[Any](
        cast("InterfaceOwner", owner), "serve", ECHO, lambda _: {"data": text}, raw=False, max_calls=1
    )
    provider.deliver(DataMessage("serve", ECHO, {}, "id1"))
    await some_steps()
    assert not provider._calls
    assert "the answer cannot be sent" in str(owner.answers)
