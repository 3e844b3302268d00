"""How long calls wait for a server that has many of them."""

from __future__ import annotations

import asyncio

import pytest

from rce.ros.xmlrpc.batches import MAX_BYTES, MAX_CALLS
from rce.ros.xmlrpc.requests import RequestQueue, RpcRequest

URI = "http://127.0.0.1:1/"


class Clock:
    """The event loop's time, which the test moves on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._now = 1000.0
        monkeypatch.setattr(asyncio.get_running_loop(), "time", lambda: self._now)

    async def pass_by(self, seconds: float) -> None:
        self._now += seconds
        for _ in range(5):
            await asyncio.sleep(0)


async def test_time_behind_answered_calls_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that answers thousands of registrations is not away because the last one has to wait."""
    clock = Clock(monkeypatch)
    queue = RequestQueue()
    first, last = (RpcRequest(URI, (b"call",), 10.0) for _ in range(2))
    queue.add(first)
    queue.add(last)
    assert queue.take(together=False) == [first]
    waiting = asyncio.create_task(queue.wait(last))
    for _ in range(5):
        await clock.pass_by(9.0)
        assert not waiting.done()
        queue.answered()
    await clock.pass_by(9.0)
    assert not waiting.done()
    await clock.pass_by(2.0)
    with pytest.raises(TimeoutError):
        await waiting


async def test_time_counts_for_a_call_that_was_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other answers of the server do not prolong it."""
    clock = Clock(monkeypatch)
    queue = RequestQueue()
    request = RpcRequest(URI, (b"call",), 10.0)
    queue.add(request)
    await clock.pass_by(9.0)
    queue.take(together=False)
    request.work = asyncio.create_task(asyncio.sleep(3600))
    waiting = asyncio.create_task(queue.wait(request))
    await clock.pass_by(9.0)
    queue.answered()
    assert not waiting.done()
    await clock.pass_by(2.0)
    with pytest.raises(TimeoutError):
        await waiting
    queue.drop(request)
    with pytest.raises(asyncio.CancelledError):
        await request.work


async def test_group_has_a_bounded_number_of_calls_and_bytes() -> None:
    queue = RequestQueue()
    large = bytes(MAX_BYTES // 2)
    for document in [b"call"] * (MAX_CALLS + 1) + [large] * 3 + [bytes(2 * MAX_BYTES)]:
        queue.add(RpcRequest(URI, (document,), 1.0))
    sizes = []
    while queue:
        sizes.append(len(queue.take(together=True)))
    assert sizes == [MAX_CALLS, 2, 2, 1]


async def test_call_of_several_calls_goes_alone() -> None:
    queue = RequestQueue()
    for is_alone in (False, True, False, False):
        queue.add(RpcRequest(URI, (b"call",), 1.0, is_alone=is_alone))
    assert [len(queue.take(together=True)) for _ in range(3)] == [1, 1, 2]


async def test_work_ends_when_all_that_wait_for_it_have_gone() -> None:
    queue = RequestQueue()
    one, other = group = [RpcRequest(URI, (b"call",), 1.0) for _ in range(2)]
    for request in group:
        queue.add(request)
    assert queue.take(together=True) == group
    work = asyncio.create_task(asyncio.sleep(3600))
    for request in group:
        request.work = work
    queue.drop(one)
    await asyncio.sleep(0)
    assert not work.cancelling()
    queue.drop(other)
    with pytest.raises(asyncio.CancelledError):
        await work


async def test_work_that_has_just_begun_can_give_its_connection_back() -> None:
    """A caller that is cancelled in the turn in which its call begins must not take a connection with it."""
    given_back = False

    async def work() -> None:
        nonlocal given_back
        try:
            await asyncio.sleep(3600)
        finally:
            given_back = True

    queue = RequestQueue()
    request = RpcRequest(URI, (b"call",), 1.0)
    queue.add(request)
    queue.take(together=False)
    request.work = asyncio.create_task(work())
    queue.drop(request)
    with pytest.raises(asyncio.CancelledError):
        await request.work
    assert given_back
