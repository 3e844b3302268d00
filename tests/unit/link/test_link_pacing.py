"""The limit in bytes per second: the mean rate holds, everybody gets a turn, small messages go ahead."""

from __future__ import annotations

import asyncio
import heapq
from typing import TYPE_CHECKING, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.link.exceptions import ProtocolError
from rce.link.flow_control import FlowControl
from rce.link.frames import Frame, FrameType
from rce.link.pacing import MIN_RATE, Bucket, Pacer

if TYPE_CHECKING:
    from collections.abc import Callable

RATE = 1_000_000


class Clock:
    """An event loop's clock and timers, moved by hand."""

    def __init__(self) -> None:
        self.now = 0.0
        self._timers: list[tuple[float, int, asyncio.TimerHandle]] = []
        self._loop = cast("asyncio.AbstractEventLoop", self)

    def time(self) -> float:
        return self.now

    def get_debug(self) -> bool:
        return False

    def _timer_handle_cancelled(self, handle: asyncio.TimerHandle) -> None:
        pass

    def call_later(self, delay: float, call: Callable[[], None]) -> asyncio.TimerHandle:
        handle = asyncio.TimerHandle(self.now + delay, call, (), self._loop)
        heapq.heappush(self._timers, (self.now + delay, id(handle), handle))
        return handle

    def pacer(self, rate: int) -> Pacer:
        return Pacer(rate, loop=self._loop)

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self._timers and self._timers[0][0] <= end:
            self.now, _, handle = heapq.heappop(self._timers)
            if not handle.cancelled():
                handle._run()
        self.now = end


class Sender:
    """Sends parts of one size for as long as it may."""

    def __init__(self, pacer: Pacer, size: int, *, urgent: bool = False) -> None:
        self.pacer, self.size, self.urgent = pacer, size, urgent
        self.sent = 0

    def go(self) -> None:
        while self.pacer.ask(self.go, urgent=self.urgent):
            self.pacer.spend(self.size, urgent=self.urgent)
            self.sent += self.size


@given(st.lists(st.tuples(st.floats(0, 1), st.integers(0, 300_000)), max_size=40))
def test_bucket_lets_no_more_pass_than_rate_and_burst(steps: list[tuple[float, int]]) -> None:
    bucket = Bucket(RATE, 50_000, 0)
    now, spent, largest = 0.0, 0, 0
    for rest, size in steps:
        now += rest
        if bucket.pause(now) == 0:
            bucket.spend(size, now)
            spent, largest = spent + size, max(largest, size)
    assert spent <= RATE * now + 50_000 + largest + 1


def test_bucket_says_when_its_debt_is_paid() -> None:
    bucket = Bucket(1000, 100, 10.0)
    bucket.spend(2100, 10.0)
    assert bucket.pause(10.0) == pytest.approx(2.001)
    assert bucket.pause(12.0) > 0
    assert bucket.pause(12.01) == 0


@pytest.mark.slow
@pytest.mark.parametrize("rate", [10_000, 1_000_000, 200_000_000])
@pytest.mark.parametrize("senders", [1, 7])
def test_senders_share_the_rate_equally(rate: int, senders: int) -> None:
    clock = Clock()
    pacer = clock.pacer(rate)
    group = [Sender(pacer, pacer.part) for _ in range(senders)]
    for sender in group:
        sender.go()
    seconds = 10_000 * pacer.part / rate
    clock.run(seconds)
    total = sum(sender.sent for sender in group)
    assert total == pytest.approx(rate * seconds, rel=0.05)
    for sender in group:
        assert sender.sent == pytest.approx(total / senders, rel=0.1)


def test_small_messages_go_ahead_of_bulk_at_once() -> None:
    clock = Clock()
    pacer = clock.pacer(RATE)
    Sender(pacer, pacer.part).go()
    for _ in range(100):
        clock.run(0.02)
        assert pacer.ask(lambda: None, urgent=True)
        pacer.spend(4_096, urgent=True)


def test_flood_of_small_messages_leaves_half_to_bulk() -> None:
    """Flood of small messages is limited and leaves half to bulk."""
    clock = Clock()
    pacer = clock.pacer(RATE)
    bulk, flood = Sender(pacer, pacer.part), Sender(pacer, 500, urgent=True)
    flood.go()
    bulk.go()
    clock.run(20)
    assert bulk.sent + flood.sent == pytest.approx(20 * RATE, rel=0.05)
    assert bulk.sent >= 0.4 * 20 * RATE
    assert flood.sent >= 0.4 * 20 * RATE


def test_another_rate_counts_at_once() -> None:
    clock = Clock()
    pacer = clock.pacer(5_000)
    sender = Sender(pacer, 100_000)
    sender.go()
    clock.run(1)
    assert sender.sent == 100_000
    pacer.change(10 * RATE)
    clock.run(1)
    assert sender.sent >= 9 * RATE


def test_a_tiny_rate_counts_as_the_least_one() -> None:
    clock = Clock()
    sender = Sender(clock.pacer(1), 100)
    sender.go()
    clock.run(100)
    assert sender.sent >= 99 * MIN_RATE


def test_nobody_is_called_after_the_end() -> None:
    clock = Clock()
    pacer = clock.pacer(5_000)
    sender = Sender(pacer, 100_000)
    sender.go()
    pacer.close()
    clock.run(1000)
    assert sender.sent == 100_000


class Wire:
    """A stream that a valve is told about."""

    def __init__(self) -> None:
        self.sent = self.received = 0
        self.grants: list[int] = []
        self.reading = True
        self.goes = 0

    def control(self, frame: Frame) -> None:
        assert frame.type is FrameType.GRANT
        self.grants.append(int.from_bytes(frame.payload))

    def resume_sending(self) -> None:
        self.goes += 1

    def pause_reading(self) -> None:
        self.reading = False

    def resume_reading(self) -> None:
        self.reading = True


def test_peer_is_granted_what_the_rate_allows() -> None:
    clock, wire = Clock(), Wire()
    flow = FlowControl(wire)
    wire.received = 777
    flow.pace(clock.pacer(RATE))
    start = clock.now
    for _ in range(20_000):
        clock.run(0.001)
        size = min(10_000, wire.grants[-1] - wire.received)
        if size:
            wire.received += size
            flow.count_received()
    assert wire.reading
    assert wire.received - 777 == pytest.approx((clock.now - start) * RATE, rel=0.1)


def test_peer_that_ignores_the_grant_is_not_read_from() -> None:
    clock, wire = Clock(), Wire()
    flow = FlowControl(wire)
    flow.pace(clock.pacer(RATE))
    for _ in range(20_000):
        clock.run(0.001)
        if wire.reading:
            wire.received += flow.read_size
            flow.count_received()
    assert wire.received == pytest.approx(20 * RATE, rel=0.1)
    flow.pace(None)
    assert wire.reading
    assert wire.grants[-1] == 2**64 - 1
    assert flow.open


def test_granted_end_sends_so_far_and_small_messages_further() -> None:
    wire = Wire()
    flow = FlowControl(wire)
    flow.allow((10_000).to_bytes(8))
    assert not flow.open
    assert flow.room(urgent=False) == 10_000
    wire.sent = 9_999
    assert flow.room(urgent=False) == 4_096
    wire.sent = 20_000
    assert flow.room(urgent=False) == 0
    assert flow.room(urgent=True) > 0
    goes = wire.goes
    flow.allow((30_000).to_bytes(8))
    assert wire.goes > goes
    assert flow.room(urgent=False) == 10_000
    with pytest.raises(ProtocolError):
        flow.allow(b"short")
