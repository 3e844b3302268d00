"""Frames in any order become messages; what is wrong harms nothing else."""

from __future__ import annotations

import json
import tracemalloc
from collections import Counter
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce.model.requests import ConfigureComponents, CreateContainer
from rce.protocol.codec import Frame, encode, encode_data, encode_message
from rce.protocol.limits import Limits
from rce.protocol.messages import CallId, DataMessage, InterfaceStatus
from rce.protocol.requests import MAX_ITEMS, STEP_ITEMS, read_request
from rce.protocol.stream import Event, Fault, LongRequest, ProtocolStream

ID = "0123456789abcdef0123456789ABCDEF"
OTHER = "f" * 32


def starred(msg: object, **more: object) -> str:
    return json.dumps({"type": "DM", "data": {"iTag": "i", "type": "a/B", "msg": msg, **more}})


def plain(event: Event) -> Any:
    """The message of an event with its binary values as bytes."""
    assert isinstance(event, DataMessage)
    return thaw(event.msg)


def thaw(value: object) -> Any:
    if isinstance(value, memoryview):
        return bytes(value)
    if isinstance(value, dict):
        return {key: thaw(inner) for key, inner in value.items()}
    return [thaw(inner) for inner in value] if isinstance(value, list) else value


def binary(id_: str, data: bytes) -> bytes:
    return id_.encode() + data


@pytest.mark.parametrize("text_first", [True, False])
def test_serialized_message_in_either_order(text_first: bool) -> None:
    stream = ProtocolStream.for_engine()
    frames = encode_data("i", "a/B", memoryview(b"payload"), "7")
    assert len(frames) == 2
    events = [stream.feed(frame, 0.0) for frame in (frames if text_first else reversed(frames))]
    assert events[0] == []
    (message,) = events[1]
    assert isinstance(message, DataMessage)
    assert isinstance(message.msg, memoryview)
    assert (bytes(message.msg), message.msg_id) == (b"payload", "7")
    assert (len(stream._assembler), stream.pending_bytes, stream.next_deadline) == (0, 0, None)


def test_binary_value_is_not_copied() -> None:
    stream = ProtocolStream.for_engine()
    text, frame = encode_data("i", "a/B", b"payload")
    stream.feed(text, 0.0)
    (message,) = stream.feed(frame, 0.0)
    assert isinstance(message, DataMessage)
    assert message.msg.obj is frame


def test_values_in_objects_in_lists_and_lists_of_values() -> None:
    stream = ProtocolStream.for_engine()
    msg = {"a": b"1", "n": {"b": b"2", "x": [1, 2]}, "l": [{"c": b"3"}, {"d": [b"4", b""]}], "e": "text"}
    frames = encode_data("i", "a/B", msg)
    assert len(frames) == 6
    assert json.loads(frames[0])["data"]["msg"]["l"][1].keys() == {"d*"}
    events = [event for frame in frames for event in stream.feed(frame, 0.0)]
    assert [plain(event) for event in events] == [msg]
    assert msg["a"] == b"1"  # the caller's object is untouched


def test_empty_list_of_binaries_needs_no_frame() -> None:
    (message,) = ProtocolStream.for_engine().feed(starred({"k*": []}), 0.0)
    assert plain(message) == {"k": []}


def test_escaped_star_is_a_star() -> None:
    stream = ProtocolStream.for_engine()
    assert stream.feed(starred({"k*": ID}).replace("*", "\\u002A"), 0.0) == []
    (message,) = stream.feed(binary(ID, b"x"), 0.0)
    assert plain(message) == {"k": b"x"}


def test_star_in_a_value_is_only_text() -> None:
    (message,) = ProtocolStream.for_engine().feed(starred({"k": "*", "l": ["a*"]}), 0.0)
    assert plain(message) == {"k": "*", "l": ["a*"]}


def test_text_may_come_as_utf8() -> None:
    stream = ProtocolStream.for_engine()
    assert stream.feed_text(starred({"k*": ID}).encode(), 0.0) == []
    assert plain(stream.feed_binary(bytearray(binary(ID, b"x")), 0.0)[0]) == {"k": b"x"}
    assert stream.feed_text(starred({"k": "ü"}).encode(), 0.0) == [DataMessage("i", "a/B", {"k": "ü"})]


def test_sides_take_only_their_types() -> None:
    (status,) = encode(InterfaceStatus(i_tag="i", status=True))
    (create,) = encode(CreateContainer(tag="c"))
    assert isinstance(ProtocolStream.for_client().feed(status, 0.0)[0], InterfaceStatus)
    assert isinstance(ProtocolStream.for_engine().feed(create, 0.0)[0], CreateContainer)
    (fault,) = ProtocolStream.for_engine().feed(status, 0.0)
    assert isinstance(fault, Fault)
    assert fault.text == "type: unknown message type 'ST'; use one of CC, CN, CX, DC, DM, LT, RC"
    assert fault.report.path == ("type",)
    assert isinstance(ProtocolStream.for_client().feed(create, 0.0)[0], Fault)


def interfaces(count: int) -> dict[str, Any]:
    item = {"endpointTag": "e", "interfaceType": "PublisherConverter", "className": "a/B"}
    items = [{**item, "interfaceTag": f"i{number}"} for number in range(count)]
    return {"addInterfaces": items, "removeInterfaces": [{"endpointTag": "e", "interfaceTag": "gone"}]}


def test_long_request_is_read_in_steps() -> None:
    """What a robot sends must not hold the loop; the same comes out as in one piece."""
    data = interfaces(MAX_ITEMS - 1)
    data["addInterfaces"][20]["className"] = "wrong"
    (event,) = ProtocolStream.for_engine().feed(json.dumps({"type": "CN", "data": data}), 0.0)
    assert isinstance(event, LongRequest)
    reading, steps = event.read(), 0
    try:
        while True:
            next(reading)
            steps += 1
    except StopIteration as end:
        request = end.value
    assert steps >= MAX_ITEMS / STEP_ITEMS - 1
    assert request == read_request("CN", data)
    assert [fault.path for fault in request.faults] == [("data", "addInterfaces", 20, "className")]
    assert len(request.add_interfaces) == MAX_ITEMS - 2


def test_too_long_a_request_is_one_fault() -> None:
    (event,) = ProtocolStream.for_engine().feed(
        json.dumps({"type": "CN", "data": interfaces(MAX_ITEMS)}), 0.0
    )
    assert isinstance(event, LongRequest)
    with pytest.raises(StopIteration) as end:
        next(event.read())
    assert isinstance(end.value.value, Fault)
    assert f"{MAX_ITEMS + 1} items are over the limit of {MAX_ITEMS}" in end.value.value.text


def test_components_with_binary_value_are_reported_as_an_item() -> None:
    stream = ProtocolStream.for_engine()
    for frame in encode_message("CN", {"setParam": [{"containerTag": "c", "name": "p", "value": b"x"}]}):
        events = stream.feed(frame, 0.0)
    (message,) = events
    assert isinstance(message, ConfigureComponents)
    assert str(message.faults[0]).startswith("data.setParam[0].value: ")


@pytest.mark.parametrize(
    ("msg", "problem"),
    [
        ({"k*": "short"}, "an id must be"),
        ({"k*": 3}, "an id must be"),
        ({"k*": None}, "an id must be"),
        ({"k*": [ID, {}]}, "an id must be"),
        ({"k*": [[ID]]}, "an id must be"),
        ({"k*": ID, "k": 1}, "there is a value 'k' already"),
        ({"*": ID}, "the name is missing"),
        ({"k*": ID, "l*": ID}, "referred to twice"),
        ({"k*": [ID, ID]}, "referred to twice"),
    ],
)
def test_wrong_reference_refuses_the_message(msg: object, problem: str) -> None:
    stream = ProtocolStream.for_engine()
    (fault,) = stream.feed(starred(msg), 0.0)
    assert isinstance(fault, Fault)
    assert problem in fault.text
    assert len(stream._assembler) == 0


@pytest.mark.parametrize("rest", [{}, {"k" * 100_000: 1}], ids=["no id", "two values"])
def test_fault_of_long_name_is_short(rest: dict[str, int]) -> None:
    (fault,) = ProtocolStream.for_engine().feed(starred({"k" * 100_000 + "*": "x", **rest}), 0.0)
    assert isinstance(fault, Fault)
    assert len(fault.text) < 400


def test_same_id_in_two_messages_refuses_the_second() -> None:
    stream = ProtocolStream.for_engine()
    stream.feed(starred({"k*": ID}), 0.0)
    assert isinstance(stream.feed(starred({"l*": ID}), 0.0)[0], Fault)
    assert plain(stream.feed(binary(ID, b"x"), 0.0)[0]) == {"k": b"x"}


def test_binary_that_comes_twice_is_refused() -> None:
    stream = ProtocolStream.for_engine()
    assert stream.feed(binary(ID, b"x"), 0.0) == []
    assert stream.feed(binary(ID, b"y"), 0.0) == [Fault(f"binary value {ID} came twice")]
    assert plain(stream.feed(starred({"k*": ID}), 0.0)[0]) == {"k": b"x"}


@pytest.mark.parametrize("frame", [b"", b"short", b"g" * 40, b"\xff" * 40, (" " * 32).encode()])
def test_binary_without_an_id_is_refused(frame: bytes) -> None:
    (fault,) = ProtocolStream.for_engine().feed(frame, 0.0)
    assert fault == Fault("a binary frame must start with 32 hexadecimal characters")


def test_incomplete_expires_after_a_minute_and_is_reported() -> None:
    stream = ProtocolStream.for_engine()
    stream.feed(starred({"k*": [ID, OTHER]}), 0.0)
    stream.feed(binary("a" * 32, b"xyz"), 10.0)
    stream.feed(binary(ID, b"x"), 20.0)
    assert stream.next_deadline == 60.0
    assert stream.expire(59.9) == []
    assert stream.expire(60.0) == [
        Fault("1 of 2 binary values of a message did not come within 60 s; dropped")
    ]
    assert stream.next_deadline == 70.0
    (fault,) = stream.expire(70.0)
    assert fault == Fault(f"no message asked for binary value {'a' * 32} (3 bytes) within 60 s; dropped")
    assert (len(stream._assembler), stream.pending_bytes) == (0, 0)
    assert stream.feed(binary(OTHER, b"late"), 71.0) == []  # nobody waits for it any more


def test_too_many_incomplete_drop_the_oldest() -> None:
    stream = ProtocolStream.for_engine(Limits(max_pending=2))
    stream.feed(starred({"k*": ID}), 0.0)
    stream.feed(binary("a" * 32, b"x"), 0.0)
    (fault,) = stream.feed(starred({"k*": OTHER}), 0.0)
    assert fault == Fault(
        "1 of 1 binary values of a message did not come and too much is incomplete; the oldest was dropped"
    )
    assert len(stream._assembler) == 2
    assert plain(stream.feed(binary(OTHER, b"y"), 0.0)[0]) == {"k": b"y"}


def test_too_many_bytes_drop_the_oldest() -> None:
    stream = ProtocolStream.for_engine(Limits(max_pending_bytes=1000))
    stream.feed(binary("a" * 32, bytes(500)), 0.0)
    (fault,) = stream.feed(binary("b" * 32, bytes(500)), 0.0)
    assert isinstance(fault, Fault)
    assert stream.pending_bytes == 532


MANY_IDS = [f"{number:032x}" for number in range(4000)]


@pytest.mark.parametrize(
    ("msg", "come"),
    [
        ({"k*": ID, "list": [{}] * 2000}, 0),
        ({"k*": ID, "list": [[]] * 2000}, 0),
        ({"k*": ID, "list": [1.5] * 15_000}, 0),
        ({"k*": ID, "text": "x" * 10_000 + "\U0001f916"}, 0),
        ({"k*": MANY_IDS}, 0),
        ({"k*": MANY_IDS}, len(MANY_IDS) - 1),
    ],
    ids=["objects", "lists", "numbers", "wide text", "references", "values"],
)
def test_memory_of_incomplete_messages_is_counted(msg: object, come: int) -> None:
    """They are kept parsed, which takes many times the memory of the text."""
    frames: list[str | bytes] = [starred(msg), *(binary(id_, b"x") for id_ in MANY_IDS[:come])]
    for frame in frames:
        ProtocolStream.for_engine().feed(frame, 0.0)  # what is loaded and cached is there now
    stream = ProtocolStream.for_engine()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for frame in frames:
            assert stream.feed(frame, 0.0) == []
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert 0.75 * grown <= stream.pending_bytes <= 5 * grown  # Python keeps some objects for reuse


@pytest.mark.parametrize("frame", ["x" * 101, b"0" * 201])
def test_too_long_a_frame_is_refused(frame: Frame) -> None:
    stream = ProtocolStream.for_engine(Limits(max_text=100, max_binary=200))
    (fault,) = stream.feed(frame, 0.0)
    assert isinstance(fault, Fault)
    assert "longer than the limit" in fault.text


def test_too_many_references_are_refused() -> None:
    stream = ProtocolStream.for_engine(Limits(max_references=2))
    (fault,) = stream.feed(starred({"k*": [f"{n:032x}" for n in range(3)]}), 0.0)
    assert fault == Fault("more than 2 binary values in a message")


def test_nesting_limit_holds_with_binary_values() -> None:
    (fault,) = ProtocolStream.for_engine().feed(
        starred({"k*": ID, "d": json.loads("[" * 64 + "]" * 64)}), 0.0
    )
    assert fault == Fault("nested deeper than 64 levels")


@pytest.mark.parametrize("value", [[b"x"], [[b"x"]], {"k": [b"x", "y"]}, {"k": [["deep", 1], [b"x"]]}])
def test_binary_that_has_no_key_cannot_be_sent(value: object) -> None:
    with pytest.raises(TypeError):
        encode_message("DM", value)


def test_ids_are_fresh() -> None:
    ids = {bytes(frame[:32]) for _ in range(100) for frame in encode_data("i", "a/B", b"")[1:]}  # type: ignore[arg-type]  # binary frames only
    assert len(ids) == 100


SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.text(st.characters(codec="utf-8"), max_size=8)
)
KEYS = st.text(st.characters(codec="utf-8", exclude_characters="*"), min_size=1, max_size=5)
VALUES = st.recursive(
    SCALARS
    | st.binary(max_size=20)
    | st.lists(st.binary(max_size=10), max_size=3)
    | st.lists(SCALARS.filter(bool)),
    lambda inner: (
        st.dictionaries(KEYS, inner, max_size=4)
        | st.lists(st.dictionaries(KEYS, inner, max_size=3), max_size=3)
    ),
    max_leaves=15,
)
MESSAGES = st.dictionaries(KEYS, VALUES, max_size=4) | st.binary(max_size=40)


@pytest.mark.slow
@settings(max_examples=80, deadline=None)
@given(st.lists(MESSAGES, min_size=1, max_size=8), st.randoms(use_true_random=False))
def test_frames_of_many_messages_in_any_order(sent: list[Any], random: Random) -> None:
    stream = ProtocolStream.for_engine()
    frames = [frame for msg in sent for frame in encode_data("i", "a/B", msg)]
    random.shuffle(frames)
    got = [plain(event) for frame in frames for event in stream.feed(frame, 0.0)]
    assert Counter(map(repr, map(ordered, got))) == Counter(map(repr, map(ordered, sent)))
    assert (len(stream._assembler), stream.pending_bytes) == (0, 0)


def ordered(value: object) -> Any:
    """The value with the keys of its objects in one order, to compare by repr."""
    if isinstance(value, dict):
        return sorted((key, ordered(inner)) for key, inner in value.items())
    return [ordered(inner) for inner in value] if isinstance(value, list) else value


HEX = st.integers(0, 5).map("{:032x}".format)
REFERENCES = HEX | st.lists(HEX | SCALARS, max_size=3) | SCALARS
NASTY_OBJECTS = st.recursive(
    SCALARS,
    lambda inner: (
        st.dictionaries(st.sampled_from(["a", "a*", "b*", "*", "msg"]), inner | REFERENCES, max_size=3)
        | st.lists(inner, max_size=3)
    ),
    max_leaves=8,
)
NASTY_FRAMES = (
    st.text(max_size=20)
    | st.binary(max_size=60)
    | NASTY_OBJECTS.map(json.dumps)
    | NASTY_OBJECTS.map(starred)
    | st.builds(binary, HEX, st.binary(max_size=50))
)


@settings(max_examples=100, deadline=None)
@given(st.lists(NASTY_FRAMES, max_size=40))
def test_no_frame_raises_and_memory_stays_bounded(frames: list[Frame]) -> None:
    limits = Limits(max_pending_bytes=2000, max_pending=5)
    stream = ProtocolStream.for_engine(limits)
    for now, frame in enumerate(frames):
        for event in [*stream.feed(frame, float(now)), *stream.expire(float(now))]:
            assert isinstance(event, DataMessage | Fault)
        assert len(stream._assembler) <= 5
        assert 0 <= stream.pending_bytes <= 2000
    stream.expire(1e9)
    assert (len(stream._assembler), stream.pending_bytes) == (0, 0)


def serialized(id_: str, **more: object) -> str:
    return json.dumps({"type": "DM", "data": {"iTag": "i", "type": "a/B", "msg*": id_, **more}})


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (serialized("short"), "an id must be"),
        (serialized(ID, msg={}), "there is a value 'msg' already"),
        (serialized(ID, msgID="x" * 256), None),
        (serialized(ID, iTag="9"), None),
    ],
)
def test_wrong_serialized_message_is_refused(text: str, problem: str | None) -> None:
    stream = ProtocolStream.for_engine()
    events = [*stream.feed(text, 0.0), *stream.feed(binary(ID, b"x"), 0.0)]
    (fault,) = events
    assert isinstance(fault, Fault)
    assert problem is None or problem in fault.text


def test_second_serialized_message_with_the_same_id_is_refused() -> None:
    stream = ProtocolStream.for_engine()
    assert stream.feed(serialized(ID), 0.0) == []
    assert stream.feed(serialized(ID), 0.0) == [Fault(f"binary value {ID} is referred to twice")]
    (message,) = stream.feed(binary(ID, b"x"), 0.0)
    assert isinstance(message, DataMessage)


def test_a_refused_serialized_message_names_its_call() -> None:
    stream = ProtocolStream.for_engine()
    stream.feed(serialized(ID, msgID="c1"), 0.0)
    (fault,) = stream.feed(serialized(ID, msgID="c2"), 0.0)
    assert isinstance(fault, Fault)
    assert fault.call == CallId("i", "c2")


def test_serialized_message_expires_and_leaves_nothing() -> None:
    stream = ProtocolStream.for_engine()
    stream.feed(serialized(ID), 0.0)
    assert len(stream.expire(60.0)) == 1
    assert (len(stream._assembler), stream.pending_bytes) == (0, 0)


def test_serialized_message_with_another_binary_beside_it() -> None:
    stream = ProtocolStream.for_engine()
    assert stream.feed(serialized(ID, **{"extra*": OTHER}), 0.0) == []
    assert stream.feed(binary(ID, b"x"), 0.0) == []
    (message,) = stream.feed(binary(OTHER, b"y"), 0.0)
    assert isinstance(message, DataMessage)
    assert bytes(message.msg) == b"x"


@pytest.mark.parametrize(("msg_id", "text"), [(7, "7"), (7.0, "7"), (-1, "-1"), (2**63, str(2**63))])
@pytest.mark.parametrize("binary_first", [True, False, None])
def test_an_integer_msg_id_is_its_text(msg_id: object, text: str, binary_first: bool | None) -> None:
    stream = ProtocolStream.for_engine()
    if binary_first is None:
        frames: list[str | bytes] = [starred({}, msgID=msg_id)]
    else:
        frames = [serialized(ID, msgID=msg_id), binary(ID, b"x")]
        frames = frames[::-1] if binary_first else frames
    (message,) = [event for frame in frames for event in stream.feed(frame, 0.0)]
    assert isinstance(message, DataMessage)
    assert message.msg_id == text


@pytest.mark.parametrize("msg_id", [1.5, True, None, [], 10**400])
def test_other_msg_ids_are_refused(msg_id: object) -> None:
    (fault,) = ProtocolStream.for_engine().feed(starred({}, msgID=msg_id), 0.0)
    assert isinstance(fault, Fault)
    assert fault.text.startswith("data.msgID: must be str")
    assert fault.call is None


@pytest.mark.parametrize(
    "frame",
    [
        starred({}, msgID="c7", type="no class"),
        starred({"k*": "short"}, msgID="c7"),
        starred({"k": [[[[[[[[[[]]]]]]]]]]}, msgID="c7"),
        json.dumps({"type": "DM", "data": {"iTag": "i", "type": "a/B", "msgID": "c7"}}),
    ],
)
def test_a_refused_message_of_a_call_names_the_call(frame: str) -> None:
    (fault,) = ProtocolStream.for_engine(Limits(max_depth=8)).feed(frame, 0.0)
    assert isinstance(fault, Fault)
    assert fault.call == ("i", "c7")
    assert fault.text.startswith("i, msgID c7: ")


@pytest.mark.parametrize("text", [starred({"k*": ID}, msgID="c7"), starred({"k*": ID}, msgID=7)])
def test_a_call_whose_binary_values_stay_away_is_named(text: str) -> None:
    stream = ProtocolStream.for_engine(Limits(expiry=1.0))
    assert stream.feed(text, 0.0) == []
    (fault,) = stream.expire(2.0)
    assert isinstance(fault, Fault)
    assert fault.call is not None
    assert fault.text.startswith(f"{fault.call}: 1 of 1 binary values")


def test_a_serialized_call_that_makes_room_is_named() -> None:
    stream = ProtocolStream.for_engine()
    assert stream.feed(serialized(ID, msgID="c7"), 0.0) == []
    (fault,) = stream.drop_oldest(1)
    assert isinstance(fault, Fault)
    assert fault.call == ("i", "c7")
