"""Queues and lanes: order within a channel, urgency between channels, bounds."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.aio.queues import OverflowPolicy
from rce.control.model import ConnectionSpec
from rce.link.channel import Channel
from rce.link.exceptions import OverloadedError, ProtocolError
from rce.link.frame_reader import FrameReader
from rce.link.frames import FRAGMENT_SIZE, LATCHED, Frame, FrameType, encode_sources, parse_sources
from rce.link.lanes import MAX_CONTROL_FRAMES, URGENT_BURST, Lanes
from rce.link.queues import SMALL_MESSAGE, Backlog, Counters, OutgoingQueue
from rce.link.settings import LinkLimits, LinkTimeouts
from rce.link.slot import InterfaceSlot
from rce.model.specs import InterfaceSpec

LIMITS = LinkLimits()


def topic(channel: int = 1, max_messages: int = 64, max_bytes: int = 10**8) -> OutgoingQueue:
    return OutgoingQueue(
        channel, Counters(), OverflowPolicy.DROP_OLDEST, max_messages=max_messages, max_bytes=max_bytes
    )


def service(channel: int = 1, max_messages: int = 4) -> OutgoingQueue:
    return OutgoingQueue(
        channel, Counters(), OverflowPolicy.REFUSE, max_messages=max_messages, max_bytes=10**8
    )


def data(channel: int, size: int, mark: int = 0) -> Frame:
    return Frame(FrameType.DATA, channel, 0, 0, bytes([mark % 256]) * size)


def drain(lanes: Lanes) -> list[tuple[FrameType, int, int]]:
    """Type, channel and payload size of all frames, in order of sending."""
    sent = []
    while (chunk := lanes.next()) is not None:
        whole = b"".join(chunk)
        kind = FrameType(whole[0])
        sent.append((kind, int.from_bytes(whole[8:16]), len(whole) - 24))
    return sent


# Queues


def test_full_queue_keeps_last_latched_of_each_source() -> None:
    """The newest of every source, and the newest list of sources, leave in order; the rest makes room."""
    queue = topic(max_messages=3)
    for source, text in ((1, b"old"), (2, b"of 2"), (0, b"a"), (1, b"of 1"), (0, b"b"), (3, b"of 3")):
        queue.push(Frame(FrameType.DATA, 1, source, LATCHED if source else 0, text))
    for ids in ((1, 2), (2, 3)):
        queue.push(encode_sources(1, ids))
    for number in range(3):
        queue.push(Frame(FrameType.DATA, 1, 0, 0, b"%d" % number))
    left = [queue.take()[0] for _ in range(len(queue))]
    texts = [bytes(frame.payload) for frame in left if frame.type is FrameType.DATA and frame.flags]
    assert texts == [b"of 2", b"of 1", b"of 3"]
    assert [parse_sources(bytes(f.payload)) for f in left if f.type is FrameType.SOURCES] == [{2, 3}]
    assert queue.waiting_bytes == 0


def test_latched_messages_stay_until_taken_back() -> None:
    """Their holder takes them back when memory is short; those of sources that ended go like others."""
    queue = topic()
    for source in (1, 2):
        queue.push(Frame(FrameType.DATA, 1, source, LATCHED, bytes(10)))
    queue.push(Frame(FrameType.DATA, 1, 0, 0, bytes(10)))
    queue.shed(100)
    assert queue.waiting_bytes == 20
    queue.release_latched(1)
    queue.shed(100)
    assert queue.waiting_bytes == 10
    queue.withdraw_latched(1)
    queue.withdraw_latched(2)
    assert (len(queue), queue.waiting_bytes, queue.counters.dropped) == (0, 0, 2)


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5000)), max_size=60))
def test_backlog_is_the_sum_of_what_waits(steps: list[tuple[int, int]]) -> None:
    grown: list[int] = []
    backlog = Backlog()
    backlog.on_growth = lambda: grown.append(backlog.bytes)
    queues = [
        OutgoingQueue(
            n,
            Counters(),
            OverflowPolicy.DROP_OLDEST if n else OverflowPolicy.REFUSE,
            max_messages=5,
            max_bytes=9000,
            backlog=backlog,
        )
        for n in range(2)
    ]
    for what, size in steps:
        queue = queues[size % 2]
        if what < 3:
            with contextlib.suppress(OverloadedError):
                queue.push(data(1, size))
                assert grown.pop() == backlog.bytes
        elif what == 3 and len(queue):
            queue.take(1000)
        elif what == 4:
            before = backlog.bytes
            queue.shed(size)
            assert queue is queues[1] or backlog.bytes == before, "what a service waits for is not dropped"
        elif what == 5:
            queue.clear()
        assert backlog.bytes == sum(queue.waiting_bytes for queue in queues)


def test_shedding_leaves_what_has_begun() -> None:
    queue = topic()
    for n in range(4):
        queue.push(data(1, 1000, n))
    queue.take(10)
    queue.shed(1500)
    assert len(queue) == 2
    assert queue.counters.dropped == 2
    queue.shed(10_000)
    assert len(queue) == 1
    assert queue.sent == 10


def test_oldest_are_dropped_and_counted() -> None:
    queue = topic(max_messages=3)
    for n in range(10):
        queue.push(data(1, 4, n))
    assert len(queue) == 3
    assert queue.head is not None
    assert queue.head.payload == bytes([7] * 4)
    assert queue.counters.dropped == 7


@pytest.mark.parametrize(("queue_size", "waiting"), [(0, 64), (1, 1), (1000, 64)])
def test_interfaces_queue_holds_as_many_as_it_says(queue_size: int, waiting: int) -> None:
    carrier = SimpleNamespace(send=OutgoingQueue.push)
    link: Any = SimpleNamespace(limits=LIMITS, carrier=carrier, spec=SimpleNamespace(copy=False))
    spec = InterfaceSpec(
        tag="velocity", type="SubscriberInterface", message_type="a/B", queue_size=queue_size
    )
    slot = InterfaceSlot(
        spec, limits=LIMITS, timeouts=LinkTimeouts(), on_change=lambda _: None, on_fault=lambda _: None
    )
    end = ConnectionSpec(id=1, link="l", interface="velocity", peer_interface="velocity")
    channel = Channel(end, slot, link, Backlog())
    channel.established = True
    for _ in range(100):
        channel.send(b"message")
    assert channel.waiting_bytes == waiting * len(b"message")
    assert slot.counters.dropped == 100 - waiting


def test_bytes_are_bounded_but_one_large_message_may_wait() -> None:
    queue = topic(max_bytes=1_000)
    queue.push(data(1, 5_000))
    assert len(queue) == 1
    queue.push(data(1, 900, 1))
    queue.push(data(1, 90, 2))
    queue.push(data(1, 90, 3))
    assert [len(queue), queue.waiting_bytes, queue.counters.dropped] == [2, 180, 2]


def test_message_on_its_way_is_not_dropped() -> None:
    queue = topic(max_messages=1)
    queue.push(data(1, 500_000, 1))
    queue.take()
    queue.push(data(1, 10, 2))
    queue.push(data(1, 10, 3))
    assert queue.counters.dropped == 1
    sizes = []
    while len(queue):
        _, start, end = queue.take()
        sizes.append(end - start)
    assert sizes == [FRAGMENT_SIZE, FRAGMENT_SIZE, 500_000 - 3 * FRAGMENT_SIZE, 10]
    assert queue.counters.messages_out == 2
    assert queue.counters.bytes_out == 500_010


def test_calls_are_refused_not_dropped() -> None:
    queue = service(max_messages=2)
    for n in (1, 2):
        queue.push(Frame(FrameType.CALL, 1, n))
    with pytest.raises(OverloadedError):
        queue.push(Frame(FrameType.CALL, 1, 3))
    assert queue.withdraw(1)
    assert not queue.withdraw(1)
    queue.push(Frame(FrameType.CALL, 1, 3))
    assert queue.head is not None
    assert queue.head.id == 2
    assert queue.counters.dropped == 0


# Lanes


def test_control_then_small_then_large() -> None:
    lanes = Lanes(LIMITS)
    lanes.add(topic(1), data(1, 300_000))
    lanes.add(topic(2), data(2, 10))
    lanes.add_control(Frame(FrameType.PING))
    assert drain(lanes) == [
        (FrameType.PING, 0, 0),
        (FrameType.DATA, 2, 10),
        (FrameType.DATA, 1, FRAGMENT_SIZE),
        (FrameType.FRAGMENT, 1, FRAGMENT_SIZE),
        (FrameType.FRAGMENT, 1, 300_000 - 2 * FRAGMENT_SIZE),
    ]
    assert not lanes


def test_small_message_overtakes_a_large_one_after_one_fragment() -> None:
    lanes = Lanes(LIMITS)
    lanes.add(topic(1), data(1, 10_000_000))
    small = topic(2)
    for _ in range(20):
        chunk = lanes.next()
        assert chunk is not None
        assert len(chunk[1]) <= FRAGMENT_SIZE
        lanes.add(small, data(2, 100))
        overtaking = lanes.next()
        assert overtaking is not None
        assert len(b"".join(overtaking)) == 124


def test_large_messages_of_channels_take_turns() -> None:
    lanes = Lanes(LIMITS)
    for channel in (1, 2, 3):
        lanes.add(topic(channel), data(channel, 2 * FRAGMENT_SIZE))
    assert [channel for _, channel, _ in drain(lanes)] == [1, 2, 3, 1, 2, 3]


def test_small_messages_do_not_starve_large_ones() -> None:
    lanes = Lanes(LIMITS)
    large, small = topic(1), topic(2, max_messages=10**6)
    lanes.add(large, data(1, 3 * FRAGMENT_SIZE))
    for _ in range(4 * URGENT_BURST // SMALL_MESSAGE):
        lanes.add(small, data(2, SMALL_MESSAGE))
    sent = drain(lanes)
    last_large = max(n for n, (_, channel, _) in enumerate(sent) if channel == 1)
    assert last_large < len(sent) - 1
    burst = URGENT_BURST // SMALL_MESSAGE
    assert [channel for _, channel, _ in sent[: burst + 1]] == [2] * burst + [1]


def test_small_message_waits_for_its_own_channel() -> None:
    lanes = Lanes(LIMITS)
    queue = topic(1)
    lanes.add(queue, data(1, 200_000))
    lanes.add(queue, data(1, 5))
    assert [size for _, _, size in drain(lanes)] == [FRAGMENT_SIZE, 200_000 - FRAGMENT_SIZE, 5]


def test_clearing_a_channel_mid_message_tells_the_peer() -> None:
    lanes = Lanes(LIMITS)
    queue = topic(1)
    lanes.add(queue, data(1, 200_000))
    lanes.next()
    lanes.clear(queue)
    lanes.add(queue, data(1, 200_000))
    kinds = [kind for kind, _, _ in drain(lanes)]
    assert kinds == [FrameType.ABORT, FrameType.DATA, FrameType.FRAGMENT]
    assert not lanes


def test_call_that_has_begun_is_withdrawn() -> None:
    """The peer is told that the rest does not come; what waits behind it follows."""
    lanes = Lanes(LIMITS)
    queue = service(1)
    lanes.add(queue, Frame(FrameType.CALL, 1, 7, 0, bytes(300_000)))
    lanes.add(queue, Frame(FrameType.CALL, 1, 8, 0, bytes(200_000)))
    reader = FrameReader(LIMITS)
    assert reader.feed(b"".join(lanes.next() or ())) == []
    assert not lanes.withdraw(queue, 9)
    assert lanes.withdraw(queue, 7)
    assert not lanes.withdraw(queue, 7)
    chunks = list(iter(lanes.next, None))
    assert [chunk[0][0] for chunk in chunks] == [FrameType.ABORT, FrameType.CALL, FrameType.FRAGMENT]
    (call,) = (frame for chunk in chunks for frame in reader.feed(b"".join(chunk)))
    assert call.id == 8
    assert queue.waiting_bytes == lanes._begun_bytes == reader.held_bytes == 0


def test_call_that_was_sent_is_not_withdrawn() -> None:
    lanes = Lanes(LIMITS)
    queue = service(1)
    lanes.add(queue, Frame(FrameType.CALL, 1, 7, 0, bytes(300_000)))
    drain(lanes)
    assert not lanes.withdraw(queue, 7)
    assert not lanes


def test_no_more_is_begun_than_the_peer_accepts() -> None:
    lanes = Lanes(LinkLimits(unfinished_bytes=400_000))
    for channel in (1, 2, 3):
        lanes.add(topic(channel), data(channel, 200_001))
    assert [channel for _, channel, _ in drain(lanes)] == [1, 1, 2, 2, 3, 3]


def test_a_peer_that_reads_nothing_is_noticed() -> None:
    lanes = Lanes(LIMITS)
    for _ in range(MAX_CONTROL_FRAMES):
        lanes.add_control(Frame(FrameType.OPEN, 1))
    with pytest.raises(ProtocolError):
        lanes.add_control(Frame(FrameType.OPEN, 1))


STEP = st.one_of(
    st.tuples(
        st.just("send"), st.integers(1, 4), st.sampled_from([0, 10, 4_096, 4_097, 20_000, 140_000, 400_000])
    ),
    st.tuples(st.just("clear"), st.integers(1, 4), st.just(0)),
    st.tuples(st.just("next"), st.integers(1, 6), st.just(0)),
)


@given(st.lists(STEP, max_size=40))
def test_reader_gets_each_channels_messages_in_order(steps: list[tuple[str, int, int]]) -> None:
    """Whatever is sent, cleared and written in between: no protocol error, order kept, nothing made up."""
    limits = LinkLimits(unfinished_bytes=600_000)
    lanes, reader = Lanes(limits), FrameReader(limits)
    queues = {channel: topic(channel, max_messages=5) for channel in range(1, 5)}
    sent: dict[int, list[bytes]] = defaultdict(list)
    got: dict[int, list[bytes]] = defaultdict(list)

    def write(count: int) -> None:
        for _ in range(count):
            for buffer in lanes.next() or ():
                for frame in reader.feed(buffer):
                    got[frame.channel].append(bytes(frame.payload))

    for number, (action, channel, size) in enumerate(steps):
        if action == "send":
            lanes.add(queues[channel], data(channel, size, number))
            sent[channel].append(bytes([number]) * size)
        elif action == "clear":
            lanes.clear(queues[channel])
        else:
            write(channel)
    write(2_000)
    assert lanes.next() is None
    for channel, queue in queues.items():
        assert len(queue) == 0
        remaining = iter(sent[channel])
        assert all(payload in remaining for payload in got[channel])
        assert queue.counters.messages_out == len(got[channel])
        assert queue.counters.messages_out + queue.counters.dropped == len(sent[channel])
