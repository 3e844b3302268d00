"""What a text weighs and where it goes, found without parsing it."""

from __future__ import annotations

import json
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.protocol.assembler import PLACE_BYTES
from rce.protocol.exceptions import MessageError
from rce.protocol.large import read_large
from rce.protocol.messages import NO_ID, DataMessage
from rce.protocol.reading import parse_json
from rce.protocol.stream import Fault, LargeData, ProtocolStream
from rce.protocol.weight import Address, check_elements, find_address, is_light, memory_of, utf8_in_steps

STRING = "std_msgs/String"


def data_message(msg: object, *, msg_first: bool = False, **more: object) -> bytes:
    rest = {"iTag": "tag", "type": STRING, "msgID": "7", **more}
    data = {"msg": msg, **rest} if msg_first else {**rest, "msg": msg}
    return json.dumps({"data": data, "type": "DM"} if msg_first else {"type": "DM", "data": data}).encode()


@pytest.mark.parametrize(
    ("text", "light"),
    [
        (data_message({"data": "x" * 10_000_000}), True),
        (data_message([[]] * 2000), True),
        (data_message([[]] * 4000), False),
        (data_message([1.5] * 10_000), True),
        (data_message([1.5] * 20_000), False),
        (data_message({"data": "\xe4" * 100_000}), True),
        (data_message({"data": "\xe4" * 200_000}), False),
        (data_message({"data": "x" * 13_000_000}), False),
    ],
    ids=["string", "lists", "many lists", "numbers", "many numbers", "escapes", "many escapes", "long"],
)
def test_what_is_light(text: bytes, *, light: bool) -> None:
    assert is_light(text) is light


@pytest.mark.parametrize("msg_first", [False, True])
def test_the_address_is_found_before_or_after_the_message(*, msg_first: bool) -> None:
    text = data_message({"iTag": "no", "type": "a/B", "data": "x" * 10_000}, msg_first=msg_first)
    assert find_address(text) == Address("tag", STRING, "7")


@pytest.mark.parametrize(
    ("written", "id_"),
    [
        ('"7"', "7"),
        ("7", "7"),
        ("7 ", "7"),
        ("7.0", "7"),
        ("-1", "-1"),
        ('"a,b"', "a,b"),
        ('"x}y"', "x}y"),
        (r'"a\"\u00e9"', 'a"\u00e9'),
        ('"nil"', NO_ID),
        ("1.5", NO_ID),
        ("1e999", NO_ID),
        ("1.2.3", NO_ID),
        ("null", NO_ID),
        ('""', NO_ID),
        (json.dumps("x" * 255), "x" * 255),
    ],
)
@pytest.mark.parametrize("is_first", [True, False])
def test_the_id_of_a_large_message_is_read_as_json(written: str, id_: str, *, is_first: bool) -> None:
    """A refusal names the call by it, so that its caller learns of the end."""
    ends = [f'"msgID": {written}', f'"msg": {json.dumps("x" * 10_000)}']
    fields = ['"iTag": "tag"', '"type": "a/B"', *(ends if is_first else ends[::-1])]
    found = find_address(f'{{"type": "DM", "data": {{{", ".join(fields)}}}}}'.encode())
    assert found == Address("tag", "a/B", id_)


def test_a_text_without_a_tag_at_its_ends_has_no_address() -> None:
    assert find_address(json.dumps({"type": "CN", "data": {"addNodes": [{}] * 5000}}).encode()) is None


@given(st.lists(st.sampled_from(["[", "{", ",", ":", '\\"', "\\\\", "x"]), max_size=50).map("".join))
def test_what_stands_in_strings_does_not_count(inner: str) -> None:
    text = json.dumps({"data": inner}).encode()
    check_elements(text, max_elements=2, max_values=2)


def test_elements_are_counted_before_anything_is_parsed() -> None:
    with pytest.raises(MessageError, match="200001 objects, lists and members is over the limit of 200000"):
        check_elements(b"[" * 200_001, max_elements=200_000, max_values=2_000_000)
    with pytest.raises(MessageError, match="2000001 values"):
        check_elements(b"," * 2_000_000, max_elements=200_000, max_values=2_000_000)
    check_elements(data_message("[" * 300_000), max_elements=10, max_values=10)


def test_large_message_returns_with_its_binary_values() -> None:
    """A large message comes out unparsed and again with its binary values."""
    stream = ProtocolStream.for_engine()
    id_ = "ab" * 16
    text = data_message({"format": "x" * 20, "many": [[]] * 3000, "data*": id_})
    (large,) = stream.feed_text(text, 0.0)
    assert isinstance(large, LargeData)
    assert read_large(large.text, large.binaries, large.address) == [id_]
    assert stream.await_binaries(large, [id_], 0.0) == []
    assert stream.pending_bytes == len(text) + PLACE_BYTES
    (complete,) = stream.feed_binary(id_.encode() + b"bytes", 0.0)
    assert isinstance(complete, LargeData)
    message = read_large(complete.text, complete.binaries, complete.address)
    assert isinstance(message, DataMessage)
    assert bytes(message.msg["data"]) == b"bytes"
    assert stream.pending_bytes == 0


def test_missing_binary_value_ends_the_call() -> None:
    """A large message whose binary value does not come ends its call."""
    stream = ProtocolStream.for_engine()
    (large,) = stream.feed_text(data_message([[]] * 3000), 0.0)
    assert isinstance(large, LargeData)
    stream.await_binaries(large, ["ab" * 16], 0.0)
    (fault,) = stream.expire(1000.0)
    assert isinstance(fault, Fault)
    assert str(fault.call) == "tag, msgID 7"


def test_a_request_with_too_many_parts_is_refused_unparsed() -> None:
    (fault,) = ProtocolStream.for_engine().feed_text(
        json.dumps({"type": "CN", "data": {"addNodes": [{}] * 5000}}).encode(), 0.0
    )
    assert isinstance(fault, Fault)
    assert "too large for a request" in fault.text


def test_an_address_that_only_seems_to_be_one_is_refused() -> None:
    text = data_message({"data": "x"}, iTag="other")
    with pytest.raises(MessageError, match="'tag'"):
        read_large(text, {}, Address("tag"))


@pytest.mark.parametrize(
    ("text", "valid"),
    [
        (b"", True),
        ("\xe4\u20ac\U0001f916".encode() * 200_000, True),
        (b"x" * 1_000_000 + b"\xff", False),
        (b"\xff" + b"x" * 1_000_000, False),
        (b"x" * 1_000_000 + b"\xe2\x82", False),
        (b"x" * (256 * 1024 - 1) + "\u20ac".encode(), True),
    ],
)
def test_utf8_is_checked_in_steps(text: bytes, valid: bool) -> None:
    steps = list(utf8_in_steps(text))
    assert all(steps) == valid
    assert len(steps) <= len(text) // (256 * 1024) + 1
    assert not any(step is False for step in steps[:-1])


@pytest.mark.parametrize(
    "text",
    [
        b"[" + b"{}," * 10_000 + b"0]",
        b"[" + b"[]," * 10_000 + b"0]",
        b"[" + b'{"a":1000},' * 10_000 + b"0]",
        b"[" + b"1.5," * 10_000 + b"0]",
        b"[" + b'"ab",' * 10_000 + b"0]",
        b'["' + b"x" * 100_000 + rb'\ud83d\ude00"]',
        b"{" + b",".join(b'"%d":[0]' % number for number in range(10_000)) + b"}",
    ],
    ids=["objects", "lists", "members", "numbers", "texts", "wide text", "keys"],
)
def test_memory_of_parsed_values_is_counted(text: bytes) -> None:
    """It may be many times the text."""
    parse_json(text)  # what it caches is there now
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        value = parse_json(text)
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert 0.75 * grown <= memory_of(value) <= 3 * grown  # Python keeps some objects for reuse
