"""What waits to be sent to the engine."""

from __future__ import annotations

import asyncio

import pytest

from rce_client.exceptions import LostError
from rce_client.sendqueue import QueuedMessage, QueueLimits, SendQueue


def queued(text: str) -> QueuedMessage:
    return QueuedMessage.of([text])


def drain(queue: SendQueue) -> list[str]:
    texts = []
    while (item := queue.pop()) is not None:
        texts.append(str(item.frames[0]))
    return texts


async def test_requests_go_first_and_topics_take_turns() -> None:
    queue = SendQueue(QueueLimits())
    for text in ("a1", "a2", "a3"):
        queue.put_data("a", queued(text))
    queue.put_data("b", queued("b1"))
    queue.put_control(queued("request"))
    assert drain(queue) == ["request", "a1", "b1", "a2", "a3"]
    assert not queue


async def test_small_messages_pass_large_ones() -> None:
    """As a velocity does; those of one topic stay in order, and large ones are not starved."""
    queue = SendQueue(QueueLimits(small_bytes=4, burst_bytes=8))
    for tag in "ab":
        queue.put_data(tag, queued(f"{tag} image"))
    for text in ("1", "2 image", "3"):
        queue.put_data("scan", queued(text))
    for text in ("v1", "v2", "v3", "v4", "v5"):
        queue.put_data("velocity", queued(text))
    sent = drain(queue)
    assert sent[:6] == ["1", "v1", "v2", "v3", "v4", "a image"]
    assert [text for text in sent if text[0] in "123"] == ["1", "2 image", "3"]
    assert sorted(sent[6:]) == ["2 image", "3", "b image", "v5"]


async def test_a_full_topic_forgets_its_oldest_and_counts() -> None:
    queue = SendQueue(QueueLimits(topic_messages=2))
    for text in ("1", "2", "3"):
        queue.put_data("a", queued(text))
    assert drain(queue) == ["2", "3"]
    assert queue.dropped == {"a": 1}


async def test_a_queue_of_one_keeps_the_newest() -> None:
    queue = SendQueue(QueueLimits())
    for text in ("1", "2", "3"):
        queue.put_data("velocity", queued(text), queue_size=1)
        queue.put_data("pose", queued(text))
    assert drain(queue) == ["3", "1", "2", "3"]


async def test_the_newest_velocity_goes_before_a_large_map() -> None:
    queue = SendQueue(QueueLimits())
    queue.put_data("map", QueuedMessage.of([bytes(10_000_000)]))
    for text in ("1", "2"):
        queue.put_data("velocity", queued(text), queue_size=1)
    first, second = queue.pop(), queue.pop()
    assert first is not None
    assert second is not None
    assert (first.frames, second.size, queue.pop()) == (["2"], 10_000_000, None)


async def test_bytes_are_limited_too_but_one_message_is_always_taken() -> None:
    queue = SendQueue(QueueLimits(topic_bytes=10))
    for text in ("x" * 6, "y" * 6, "z" * 100):
        queue.put_data("a", queued(text))
    assert drain(queue) == ["z" * 100]
    assert queue.dropped == {"a": 2}


async def test_get_waits() -> None:
    queue = SendQueue(QueueLimits())
    waiting = asyncio.ensure_future(queue.get())
    await asyncio.sleep(0)
    assert not waiting.done()
    queue.put_data("a", queued("x"))
    assert (await waiting).frames == ["x"]


async def test_clearing_tells_who_waits() -> None:
    queue = SendQueue(QueueLimits())
    item = queued("x")
    item.sent = asyncio.get_running_loop().create_future()
    queue.put_control(item)
    queue.put_data("a", queued("y"))
    queue.clear()
    with pytest.raises(LostError):
        await item.sent
    assert queue.pop() is None


async def test_full_is_about_control() -> None:
    queue = SendQueue(QueueLimits(control_messages=1))
    assert not queue.full
    queue.put_control(queued("x"))
    assert queue.full
