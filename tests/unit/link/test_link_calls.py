"""Who waits for answers, and who works on them."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, cast

import pytest

from rce.guard.holdings import Holdings
from rce.link.calls import CallServer, PendingCalls
from rce.link.carrier import Carrier, LocalCarrier
from rce.link.exceptions import (
    MessageTooLargeError,
    NotConnectedError,
    OverloadedError,
    PeerFaultError,
    PeerLostError,
    ProtocolError,
)
from rce.link.frames import Frame, FrameType
from rce.link.settings import LinkLimits

if TYPE_CHECKING:
    from rce.link.channel import Channel


class FakeChannel:
    """Notes answers."""

    def __init__(self) -> None:
        self.replies: dict[int, bytes] = {}
        self.faults: dict[int, str] = {}
        self.answered = asyncio.Event()

    def reply(self, call_id: int, answer: bytes) -> None:
        self.replies[call_id] = answer
        self.answered.set()

    def fault(self, call_id: int, error: BaseException) -> None:
        self.faults[call_id] = str(error)
        self.answered.set()

    def as_channel(self) -> Channel:
        return cast("Channel", self)


async def test_pending_calls_have_their_own_ids_and_answers() -> None:
    calls = PendingCalls(3)
    (a, first), (b, second), (c, third) = (calls.add() for _ in range(3))
    assert len({a, b, c}) == 3
    with pytest.raises(OverloadedError):
        calls.add()
    calls.answer(b, b"two")
    calls.fail(a, PeerFaultError("no"))
    calls.answer(77, b"nobody asked")
    assert await second == b"two"
    with pytest.raises(PeerFaultError, match="no"):
        await first
    calls.fail_all(lambda: PeerLostError("gone"))
    with pytest.raises(PeerLostError):
        await third
    assert not calls.drop(c)
    assert len(calls) == 0


async def test_a_request_costs_the_same_while_many_wait() -> None:
    """A peer may let many wait, and send and cancel others: each costs it a few bytes."""

    async def seconds(waiting: int) -> float:
        channel = FakeChannel().as_channel()
        server = CallServer(never, LinkLimits(serving=1, waiting=waiting + 2), "ask")
        for call_id in range(waiting + 1):
            server.accept(channel, call_id, b"")
        spent = []
        for _ in range(20):
            begin = time.perf_counter()
            for call_id in range(waiting + 1, waiting + 51):
                assert not server.has(channel, call_id)
                server.accept(channel, call_id, b"")
                server.cancel(channel, call_id)
            spent.append(time.perf_counter() - begin)
        await server.close()
        return min(spent)

    async def never(payload: bytes) -> bytes:
        await asyncio.get_running_loop().create_future()
        return payload

    assert await seconds(10_000) < 20 * await seconds(10)


async def test_server_serves_few_at_a_time_and_refuses_too_many() -> None:
    release, both = asyncio.Event(), asyncio.Event()
    running = 0
    most = 0

    async def serve(payload: bytes) -> bytes:
        nonlocal running, most
        running += 1
        most = max(most, running)
        if running == 2:
            both.set()
        await release.wait()
        running -= 1
        return payload

    channel = FakeChannel()
    server = CallServer(serve, LinkLimits(serving=2, waiting=3), "test")
    for n in range(5):
        server.accept(channel.as_channel(), n, b"%d" % n)
    with pytest.raises(OverloadedError):
        server.accept(channel.as_channel(), 5, b"")
    assert server.has(channel.as_channel(), 0)
    assert server.has(channel.as_channel(), 4)
    await both.wait()
    release.set()
    async with asyncio.timeout(5):
        while len(channel.replies) < 5:
            channel.answered.clear()
            await channel.answered.wait()
    assert channel.replies == {n: b"%d" % n for n in range(5)}
    assert most == 2
    await server.close()
    with pytest.raises(NotConnectedError):
        server.accept(channel.as_channel(), 9, b"")


async def test_cancelled_requests_get_no_answer() -> None:
    cancelled: list[bytes] = []
    started = asyncio.Event()

    async def serve(payload: bytes) -> bytes:
        started.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            cancelled.append(payload)
            raise
        return payload

    one, other = FakeChannel(), FakeChannel()
    server = CallServer(serve, LinkLimits(serving=2, waiting=3), "test")
    server.accept(one.as_channel(), 1, b"a")
    server.accept(other.as_channel(), 1, b"b")
    server.accept(one.as_channel(), 2, b"c")
    await started.wait()
    server.cancel(one.as_channel())
    assert server.has(other.as_channel(), 1)
    assert not server.has(one.as_channel(), 2)
    await server.close()
    assert sorted(cancelled) == [b"a", b"b"]
    assert one.replies == other.replies == {}
    assert one.faults == other.faults == {}


async def test_what_a_server_raises_is_told_to_the_peer() -> None:
    async def serve(payload: bytes) -> bytes:
        raise ValueError("nothing like that here")

    channel = FakeChannel()
    server = CallServer(serve, LinkLimits(), "test")
    server.accept(channel.as_channel(), 1, b"")
    await channel.answered.wait()
    assert channel.faults == {1: "nothing like that here"}
    await server.close()


async def test_server_that_waits_for_a_cancelled_task_answers() -> None:
    """Only a cancelled request gets no answer."""

    async def serve(payload: bytes) -> bytes:
        task = asyncio.create_task(asyncio.sleep(0))
        task.cancel()
        await task
        return payload

    channel, holdings = FakeChannel(), Holdings()
    server = CallServer(serve, LinkLimits(), "test", holdings)
    server.accept(channel.as_channel(), 1, b"request")
    async with asyncio.timeout(60):
        await channel.answered.wait()
    assert list(channel.faults) == [1]
    assert holdings.bytes == 0
    await server.close()


def test_errors_have_texts() -> None:
    assert str(NotConnectedError()) == "not connected"
    assert "70 bytes" in str(MessageTooLargeError(70, 64))
    assert "64 bytes" in str(MessageTooLargeError(70, 64))


class Ping:
    """Answers every frame at once; refuses ERROR."""

    def __init__(self, carrier: LocalCarrier) -> None:
        self.carrier = carrier
        self.count = 0
        self.lost: list[Exception] = []
        self.enough = asyncio.Event()

    def frame_received(self, frame: Frame) -> None:
        if frame.type is FrameType.HELLO:
            raise ProtocolError("not here")
        self.count += 1
        if self.count == 5_000:
            self.enough.set()
        else:
            self.carrier.control(frame)

    def grew(self) -> None:
        pass

    def carrier_lost(self, carrier: Carrier, reason: Exception) -> None:
        self.lost.append(reason)
        self.enough.set()


async def test_local_carrier_does_not_recurse_or_hold_the_loop() -> None:
    one, other = LocalCarrier.pair()
    a, b = Ping(one), Ping(other)
    one.control(Frame(FrameType.PING))
    one.start(a)
    other.start(b)
    turns = 0
    while not a.enough.is_set() and not b.enough.is_set():
        await asyncio.sleep(0)
        turns += 1
    assert turns > 1_000
    one.close()
    other.control(Frame(FrameType.PING))
    await other.wait_closed()
    assert len(b.lost) == 1
    assert a.lost == []


async def test_local_carrier_ends_at_broken_rules() -> None:
    one, other = LocalCarrier.pair()
    a, b = Ping(one), Ping(other)
    one.start(a)
    other.start(b)
    one.control(Frame(FrameType.HELLO))
    await a.enough.wait()
    assert [type(reason) for reason in b.lost] == [ProtocolError]
    assert len(a.lost) == 1


async def test_unanswered_requests_are_dropped_oldest_first() -> None:
    """Requests are held until they are answered and given up oldest first."""
    release = asyncio.Event()

    async def serve(payload: bytes) -> bytes:
        await release.wait()
        return payload

    holdings = Holdings()
    server = CallServer(serve, LinkLimits(serving=2, waiting=3), "test", holdings)
    channel = FakeChannel()
    for number in range(4):
        server.accept(channel.as_channel(), number, bytes(10))
    assert holdings.bytes == 40
    holdings.shed(15)
    assert holdings.bytes == 20
    assert list(channel.faults) == [0, 1]
    release.set()
    while holdings.bytes:
        await asyncio.sleep(0)
    assert list(channel.replies) == [2, 3]
    await server.close()
