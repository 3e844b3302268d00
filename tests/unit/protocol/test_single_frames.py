"""A message that is binary as a whole in one frame, between peers that agreed on it."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.model.names import MAX_NAME_LENGTH
from rce.protocol.codec import encode_data
from rce.protocol.http import FEATURES, read_features
from rce.protocol.limits import DEFAULT_LIMITS, MAX_MESSAGE_ID_LENGTH, Limits
from rce.protocol.messages import NO_ID, DataMessage
from rce.protocol.single import MARK, MAX_HEADER, MAX_PAYLOAD
from rce.protocol.stream import Event, Fault, ProtocolStream

PAGE = Path(__file__).parents[3] / "docs" / "protocol.md"
NAMES = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,20}", fullmatch=True)
IDS = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=MAX_MESSAGE_ID_LENGTH)


def feed(frame: bytes, limits: Limits = DEFAULT_LIMITS) -> Event:
    """What the engine makes of the frame of a client that agreed on one frame; nothing is left of it."""
    stream = ProtocolStream.for_engine(limits, single=True)
    (event,) = stream.feed(frame, 0.0)
    assert (len(stream._assembler), stream.pending_bytes, stream.next_deadline) == (0, 0, None)
    return event


def frame_of(header: object, payload: bytes = b"payload") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("!BH", 1, len(text)) + text + payload


def fault(frame: bytes) -> Fault:
    event = feed(frame)
    assert isinstance(event, Fault)
    return event


@given(tag=NAMES, package=NAMES, msg_id=IDS, latch=st.sampled_from(["", "1", "5.12"]), payload=st.binary())
def test_message_makes_the_round_trip(
    tag: str, package: str, msg_id: str, latch: str, payload: bytes
) -> None:
    (frame,) = encode_data(tag, f"{package}/Type", payload, msg_id, latch, single=True)
    assert isinstance(frame, bytes)
    for stream in (ProtocolStream.for_engine(single=True), ProtocolStream.for_client(single=True)):
        for _ in range(2):  # the second header may be remembered
            (message,) = stream.feed(frame, 0.0)
            assert isinstance(message, DataMessage)
            assert isinstance(message.msg, memoryview)
            assert message.msg.obj is frame
            assert bytes(message.msg) == payload
            told = (message.i_tag, message.message_type, message.msg_id, message.latch)
            assert told == (tag, f"{package}/Type", msg_id, latch)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_one_fault(data: bytes) -> None:
    event = feed(bytes([MARK]) + data)
    assert isinstance(event, Fault | DataMessage)


@pytest.mark.slow
@given(st.recursive(st.none() | st.integers() | st.text(), lambda inner: st.dictionaries(st.text(), inner)))
def test_any_json_as_header_is_one_fault(header: object) -> None:
    assert isinstance(feed(frame_of(header)), Fault)


def test_longest_names_fit_in_the_header() -> None:
    name = "n" * MAX_NAME_LENGTH
    (frame,) = encode_data(
        name, f"{name}/{name[1:]}", b"", "\x01" * MAX_MESSAGE_ID_LENGTH, "\x01" * 64, single=True
    )
    assert isinstance(frame, bytes)
    assert len(frame) < MAX_HEADER
    message = feed(frame)
    assert isinstance(message, DataMessage)
    assert message.msg_id == "\x01" * MAX_MESSAGE_ID_LENGTH


def test_msg_id_may_be_left_out_or_an_integer() -> None:
    for header, msg_id in (({}, NO_ID), ({"msgID": 7}, "7"), ({"msgID": 7.0, "else": [1]}, "7")):
        message = feed(frame_of({"iTag": "i", "type": "a/B", **header}))
        assert isinstance(message, DataMessage)
        assert (message.msg_id, bytes(message.msg)) == (msg_id, b"payload")


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (b"\x01", "at least 3 bytes long, not 1"),
        (b"\x01\x00\x05{}", "5 bytes has no room for its header of 5"),
        (
            b"\x01\xff\xff" + b" " * 70_000,
            f"a header of 65535 bytes is longer than the limit of {MAX_HEADER}",
        ),
        (frame_of(b""), "not valid JSON"),
        (frame_of(b"\xff{}"), "not valid JSON"),
        (frame_of(b'{"a":' * 800), ""),
        (frame_of([]), "data: must be an object"),
        (frame_of({"iTag": "i"}), "data.type: is missing"),
        (frame_of({"iTag": "0", "type": "a/B"}), "data.iTag: "),
        (frame_of({"iTag": "i", "type": "a/B", "msg": {}}), "data.msg: leave it out"),
        (frame_of({"iTag": "i", "type": "a/B", "msg*": "0" * 32}), "data.msg*: leave it out"),
    ],
)
def test_wrong_frame_is_told_what_is_wrong(frame: bytes, words: str) -> None:
    assert words in fault(frame).text


def test_refused_service_message_names_its_call() -> None:
    refused = fault(frame_of({"iTag": "ask", "type": "nonsense", "msgID": 9}))
    assert refused.text.startswith("ask, msgID 9: data.type: ")
    assert refused.call == ("ask", "9")


def test_frame_is_counted_as_a_binary_frame() -> None:
    frame = frame_of({"iTag": "i", "type": "a/B"}, bytes(100))
    assert isinstance(feed(frame, Limits(max_binary=len(frame))), DataMessage)
    refused = feed(frame, Limits(max_binary=len(frame) - 1))
    assert isinstance(refused, Fault)
    assert "longer than the limit" in refused.text


def test_who_did_not_agree_hears_what_it_heard_before() -> None:
    for stream in (ProtocolStream.for_engine(), ProtocolStream.for_client()):
        (event,) = stream.feed(frame_of({"iTag": "i", "type": "a/B"}), 0.0)
        assert isinstance(event, Fault)
        assert event.text == "a binary frame must start with 32 hexadecimal characters"


def test_messages_in_two_frames_go_on_beside_it() -> None:
    stream = ProtocolStream.for_engine(single=True)
    text, binary = encode_data("i", "a/B", b"two")
    (single,) = encode_data("i", "a/B", b"one", single=True)
    events = [event for frame in (text, single, binary) for event in stream.feed(frame, 0.0)]
    assert [bytes(event.msg) for event in events if isinstance(event, DataMessage)] == [b"one", b"two"]


def test_headers_that_are_remembered_are_bounded() -> None:
    stream = ProtocolStream.for_engine(single=True)
    for number in range(1000):
        (event,) = stream.feed(encode_data(f"i{number}", "a/B", b"", single=True)[0], 0.0)
        assert isinstance(event, DataMessage)
    assert stream._single is not None
    assert len(stream._single._known) == 64


def test_what_is_not_binary_or_too_long_takes_the_usual_frames() -> None:
    for msg in ({"data": "x"}, "no", {"data": b"x"}, memoryview(bytes(MAX_PAYLOAD + 1))):
        frames = encode_data("i", "a/B", msg, single=True)
        assert isinstance(frames[0], str)


def test_feature_is_asked_for_by_name() -> None:
    assert read_features("features=single-frame,later") == {"single-frame"}
    assert read_features("features=latch,single-frame") == FEATURES
    assert read_features("userID=u") == frozenset()


def test_example_of_the_page_is_such_a_frame() -> None:
    (block,) = re.findall(r"```hex\n(.*?)```", PAGE.read_text(), re.DOTALL)
    rows = [re.sub(r"\s*\|.*", "", row) for row in block.splitlines()]
    message = feed(bytes.fromhex("".join(rows)))
    assert isinstance(message, DataMessage)
    assert (message.i_tag, message.message_type, bytes(message.msg)) == (
        "say",
        "std_msgs/String",
        b"\x05\0\0\0hello",
    )
