"""Throttles, the frames of relay links, and names in namespaces."""

from __future__ import annotations

import asyncio
import itertools
import socket
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.ros.multimaster.errors import LinkBrokenError, LinkFullError
from rce.ros.multimaster.relay import connection as relay_connection
from rce.ros.multimaster.relay.connection import QUEUE, SHORT, RelayConnection
from rce.ros.multimaster.relay.frames import (
    NO_SOURCE,
    Answer,
    Call,
    Challenge,
    Data,
    Decoder,
    Frame,
    Hello,
    Offer,
    Ping,
    Proof,
    Sources,
    Want,
    encode,
)
from rce.ros.multimaster.relay.kinds import ServiceKind, TopicKind
from rce.ros.multimaster.relay.namespace import add_namespace, strip_namespace
from rce.ros.multimaster.relay.throttle import ByteThrottle, MessageThrottle

NUMBERS = st.integers(0, 2**32 - 1)
TEXT = st.text(max_size=5)
TOPIC_KINDS = st.builds(TopicKind, TEXT, TEXT, TEXT)
SERVICE_KINDS = st.builds(ServiceKind, TEXT, TEXT, TEXT, TEXT)
FRAMES: st.SearchStrategy[Frame] = st.one_of(
    st.builds(Hello, TEXT, TEXT, TEXT),
    st.builds(Challenge, TEXT),
    st.builds(Proof, TEXT),
    st.builds(Want, st.frozensets(NUMBERS, max_size=3)),
    st.builds(Data, NUMBERS, NUMBERS, st.binary(max_size=50)),
    st.builds(Sources, NUMBERS, st.frozensets(NUMBERS, max_size=3)),
    st.builds(Call, NUMBERS, NUMBERS, st.binary(max_size=50)),
    st.builds(Answer, NUMBERS, st.booleans(), st.binary(max_size=50)),
    st.builds(Ping),
    st.builds(
        Offer,
        st.dictionaries(NUMBERS, st.tuples(TEXT, TOPIC_KINDS), max_size=2),
        st.dictionaries(NUMBERS, st.tuples(TEXT, SERVICE_KINDS), max_size=2),
    ),
)


@given(st.lists(FRAMES, max_size=5), st.integers(1, 30))
def test_frames_arrive_however_they_are_cut(frames: list[Frame], size: int) -> None:
    stream = b"".join(piece for frame in frames for piece in encode(frame))
    decoder = Decoder()
    cuts = (stream[begin : begin + size] for begin in range(0, len(stream), size))
    assert list(itertools.chain.from_iterable(map(decoder.feed, cuts))) == frames


def test_a_message_is_not_copied_on_its_way_out() -> None:
    payload = b"x" * 100_000
    assert encode(Data(1, NO_SOURCE, payload))[-1] is payload


@given(st.binary(max_size=60))
def test_any_bytes_are_frames_or_break_the_link(stream: bytes) -> None:
    try:
        list(Decoder().feed(stream))
    except LinkBrokenError:
        return


async def sent_by_a_full_connection(*frames: Frame) -> list[Frame]:
    """Send frames over a connection that is full, then let it write; return what arrives."""
    loop = asyncio.get_running_loop()
    ours, theirs = socket.socketpair()
    with theirs:
        theirs.setblocking(False)
        _, connection = await loop.create_connection(RelayConnection, sock=ours)
        connection.pause_writing()
        for frame in frames:
            connection.send(frame)
        connection.resume_writing()
        connection.send(Ping())
        decoder, found = Decoder(), list[Frame]()
        while Ping() not in found:
            found += decoder.feed(await loop.sock_recv(theirs, 65536))
        connection.abort()
        await connection.gone.wait()
    return found[:-1]


async def test_full_connection_keeps_latched_messages() -> None:
    """A map that is published once outlives a stream of images."""
    the_map, images = Data(1, 7, b"map"), [Data(2, NO_SOURCE, b"%d" % number) for number in range(200)]
    assert await sent_by_a_full_connection(the_map, *images) == [the_map, *images[-QUEUE:]]


async def test_full_connection_keeps_the_newest_of_each_source() -> None:
    frames = [Data(1, source, b"%d" % number) for number in range(200) for source in (1, 2)]
    found = await sent_by_a_full_connection(*frames, Sources(1, frozenset({2})))
    assert found[-3:] == [*frames[-2:], Sources(1, frozenset({2}))]
    assert len(found) <= QUEUE + 3


async def test_side_that_does_not_read_answers_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short answers are taken by a full connection, but not without an end."""
    monkeypatch.setattr(relay_connection, "MAX_WAITING", 2**21)
    loop = asyncio.get_running_loop()
    ours, theirs = socket.socketpair()
    with theirs:
        _, connection = await loop.create_connection(RelayConnection, sock=ours)
        calls = (Call(1, number, bytes(2**19)) for number in range(100))
        with pytest.raises(LinkFullError, match="too slow"):
            list(map(connection.send, calls))
        connection.send(Answer(1, ok=False, payload=b"too slow"))
        assert not connection.ended.done()
        with pytest.raises(LinkFullError):
            connection.send(Answer(1, ok=True, payload=bytes(2**20)))
        for number in range(2**13):
            connection.send(Answer(number, ok=False, payload=bytes(SHORT)))
        with pytest.raises(LinkBrokenError, match="does not read the answers"):
            await connection.ended
        await connection.gone.wait()


@pytest.mark.parametrize(
    "stream",
    [b"\0\0\0\0P", b"\xff\xff\xff\xffD", b"\x01\0\0\0Z", b"\x02\0\0\0D1", b"\x03\0\0\0O[]", b"\x03\0\0\0H{}"],
)
def test_broken_frames(stream: bytes) -> None:
    with pytest.raises(LinkBrokenError):
        list(Decoder().feed(stream))


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        ("H", '{"protocol":Infinity,"name":"x"}'),
        ("H", '{"protocol":1e999,"name":"x"}'),
        ("H", '{"protocol":NaN,"name":"x"}'),
        ("H", '{"protocol":2,"name":["x"]}'),
        ("H", '{"protocol":2,"name":"\\ud800"}'),
        ("N", '{"nonce":"\\udfff"}'),
        ("N", '{"nonce":null}'),
        ("R", '{"proof":"\\ud800"}'),
        ("R", '{"proof":' + "[" * 1000 + "}"),
        ("W", "[Infinity]"),
        ("W", "[-1]"),
        ("W", "[4294967296]"),
        ("W", "[1.5]"),
        ("W", "7"),
        ("S", "[1]"),
        ("S", "[1,[Infinity]]"),
        ("S", '["1",[]]'),
        ("O", '{"topics":[[Infinity,"/a","t","m","d"]],"services":[]}'),
        ("O", '{"topics":[[4294967296,"/a","t","m","d"]],"services":[]}'),
        ("O", '{"topics":[[1,"/a","t","m","\\ud800"]],"services":[]}'),
        ("O", '{"topics":[[1,"/a","t","m"]],"services":[]}'),
        ("O", '{"topics":[],"services":[[-1,"/a","t","m","q","r"]]}'),
        ("O", '{"topics":[],"services":[[1,null,"t","m","q","r"]]}'),
    ],
)
def test_values_that_no_side_sends_break_the_link(kind: str, body: str) -> None:
    stream = struct.pack("<IB", 1 + len(body), ord(kind)) + body.encode()
    with pytest.raises(LinkBrokenError, match="cannot be read"):
        list(Decoder().feed(stream))


def test_messages_per_second() -> None:
    throttle = MessageThrottle(2)
    assert [throttle.passes(now, 1) for now in (0, 0.4, 0.5, 0.9, 1.0)] == [True, False, True, False, True]
    assert throttle.passes(0.1, 1)  # the clock was set back


def test_bytes_per_second() -> None:
    throttle = ByteThrottle(100, window=1)
    assert [throttle.passes(now, size) for now, size in ((0, 60), (0.1, 60), (0.2, 40), (0.9, 1))] == [
        True,
        False,
        True,
        False,
    ]
    assert throttle.passes(1.0, 60)


@given(st.lists(st.tuples(st.floats(0, 10), st.integers(1, 200)), max_size=40))
def test_no_window_has_more_bytes_than_allowed(messages: list[tuple[float, int]]) -> None:
    throttle = ByteThrottle(100, window=2)
    passed = [(now, size) for now, size in sorted(messages) if throttle.passes(now, size)]
    for begin, _ in passed:
        assert sum(size for now, size in passed if begin <= now < begin + 2) <= 200


@pytest.mark.parametrize("rate", [0, -1, float("nan")])
def test_rates_must_be_positive(rate: float) -> None:
    with pytest.raises(ValueError, match="above 0"):
        MessageThrottle(rate)
    with pytest.raises(ValueError, match="above 0"):
        ByteThrottle(rate)


@given(st.lists(st.sampled_from("abc"), min_size=1).map(lambda parts: "/" + "/".join(parts)))
def test_a_namespace_can_be_taken_off_again(name: str) -> None:
    assert strip_namespace(add_namespace(name, "/Robot1"), "/Robot1") == name
    assert strip_namespace(name, "/Robot1") is None
