"""Messages to bytes and back; rosbags is the oracle."""

import math
import struct
from array import array
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from rce.ros.types import Duration, Field, MessageType, SerializationError, Time, TypeRegistry, objects
from rce.ros.types.registry import builtin_definitions
from rce.ros.types.values import NUMBERS

TYPES = TypeRegistry()
SEPARATOR = "=" * 80
SHAPES = ("{} {}", "{}[] {}s", "{}[3] three_{}")
BUILTIN = (*NUMBERS, "string", "time", "duration")
EVERYTHING = TYPES.from_definition(
    "mine/Everything",
    "".join(shape.format(name, f"f_{name}") + "\n" for name in (*BUILTIN, "Inner") for shape in SHAPES)
    + f"{SEPARATOR}\nMSG: mine/Inner\nuint8 a\nstring b\nfloat64 c\nInnermost[] d\n"
    + f"{SEPARATOR}\nMSG: mine/Innermost\nint16 e\n",
)


def number_values(name: str) -> st.SearchStrategy[Any]:
    number = NUMBERS[name]
    if name == "bool":
        return st.booleans()
    if number.is_float:
        return st.floats(width=32 if number.size == 4 else 64, allow_nan=False)
    return st.integers(number.low, number.high)


def element_values(field: Field) -> st.SearchStrategy[Any]:
    if field.message is not None:
        return message_values(field.message)
    if field.type in NUMBERS:
        return number_values(field.type)
    if field.type == "string":
        return st.text()
    if field.type == "time":
        return st.builds(Time, st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
    return st.builds(Duration, st.integers(-(2**31), 2**31 - 1), st.integers(-(2**31), 2**31 - 1))


def message_values(kind: MessageType) -> st.SearchStrategy[Any]:
    fields: dict[str, st.SearchStrategy[Any]] = {}
    for field in kind.fields:
        size = (0, 4) if field.length is None else (field.length, field.length)
        if field.is_bytes:
            fields[field.name] = st.binary(min_size=size[0], max_size=size[1])
        elif field.is_array:
            fields[field.name] = st.lists(element_values(field), min_size=size[0], max_size=size[1])
        else:
            fields[field.name] = element_values(field)
    return st.fixed_dictionaries(fields).map(lambda values: kind.new(**values))


@given(message_values(EVERYTHING))
def test_every_field_type_survives_the_wire(message: Any) -> None:
    data = EVERYTHING.serialize(message)
    assert EVERYTHING.deserialize(data) == message
    assert EVERYTHING.deserialize(memoryview(bytearray(data))) == message


@pytest.mark.slow
@given(message_values(EVERYTHING))
def test_size_is_that_of_the_written_message(message: Any) -> None:
    written = EVERYTHING.serialize(message)
    texts = [message.f_string, *message.f_strings, *message.three_f_string]
    texts += [inner.b for inner in (message.f_Inner, *message.f_Inners, *message.three_f_Inner)]
    surplus = sum(len(text.encode()) - len(text) for text in texts)  # a character counts as one byte
    assert EVERYTHING.size(message) == len(written) - surplus


def test_size_of_other_sequences() -> None:
    everything = EVERYTHING.new()
    before = EVERYTHING.size(everything)
    everything.f_uint8s = np.zeros((3, 4), np.uint8)
    everything.f_float64s = np.zeros(5)
    assert EVERYTHING.size(everything) == before + 12 + 40 == len(EVERYTHING.serialize(everything))
    everything.f_string = None
    assert EVERYTHING.size(everything) == EVERYTHING.min_size


@pytest.mark.slow
@given(st.data())
def test_the_bytes_are_those_that_rosbags_reads_and_writes(data: st.DataObject) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    names = [name for kind, name in builtin_definitions() if kind == "msg"]
    name = data.draw(
        st.sampled_from([name for name in names if name.replace("/", "/msg/") in store.fielddefs])
    )
    kind, full = TYPES.message(name), name.replace("/", "/msg/")
    payload = kind.serialize(data.draw(message_values(kind)))
    assert bytes(store.serialize_ros1(store.deserialize_ros1(payload, full), full)) == payload


@given(st.binary(max_size=400))
def test_garbage_is_read_or_refused(data: bytes) -> None:
    for name in ("nav_msgs/Path", "std_msgs/Int32MultiArray", "diagnostic_msgs/DiagnosticArray"):
        kind = TYPES.message(name)
        try:
            message = kind.deserialize(data)
        except SerializationError as error:
            assert error.reason  # noqa: PT017
        else:
            assert len(kind.serialize(message)) == len(data)


@given(message_values(TYPES.message("nav_msgs/Path")), st.data())
def test_every_cut_or_lengthened_message_is_refused(message: Any, data: st.DataObject) -> None:
    kind = TYPES.message("nav_msgs/Path")
    payload = kind.serialize(message)
    cut = data.draw(st.integers(0, len(payload) - 1))
    with pytest.raises(SerializationError, match="missing"):
        kind.deserialize(payload[:cut])
    with pytest.raises(SerializationError, match="1 bytes too many"):
        kind.deserialize(payload + b"x")


def test_defaults_are_zero_and_empty_and_never_shared() -> None:
    one, two = EVERYTHING.new(), EVERYTHING.new()
    assert one == two
    assert one.three_f_string == ["", "", ""]
    assert one.three_f_uint8 == b"\0\0\0"
    assert one.three_f_float32 == array("f", [0, 0, 0])
    assert one.f_time == Time(0, 0)
    one.f_Inner.a = 7
    one.f_int32s.append(1)
    assert (two.f_Inner.a, len(two.f_int32s)) == (0, 0)


def test_messages_are_made_of_loose_values() -> None:
    path = TYPES.message("nav_msgs/Path").new(
        header={"frame_id": "map", "stamp": Time(1, 2)}, poses=[{"pose": {"position": {"x": 1}}}]
    )
    assert path.header.frame_id == "map"
    assert path.poses[0].pose.position.x == 1
    assert TYPES.message("nav_msgs/Path").serialize({"header": {"seq": 1}}) == b"\x01" + bytes(19)


def test_arrays_take_numpy_lists_tuples_and_views() -> None:
    scan = TYPES.message("sensor_msgs/LaserScan")
    expected = scan.serialize(scan.new(ranges=[1.0, 2.0]))
    for ranges in (
        np.array([1, 2], np.float32),
        np.array([1, 2], np.float64),
        np.array([1, 9, 2], np.float32)[::2],
        np.array([1, 2], np.int64),
        (1, 2),
        array("f", [1, 2]),
    ):
        message = scan.new()
        message.ranges = ranges
        assert scan.serialize(message) == expected
    assert np.asarray(scan.deserialize(expected).ranges).dtype == np.float32


def test_equal_type_of_other_registry_is_taken() -> None:
    """A message of an equal type of another registry is taken and others refused."""
    string = TypeRegistry().message("std_msgs/String")
    assert TYPES.message("std_msgs/String").serialize(string.new(data="x")) == b"\x01\0\0\0x"
    with pytest.raises(SerializationError, match="a std_msgs/String is not a std_msgs/Bool"):
        TYPES.message("std_msgs/Bool").serialize(string.new())


def test_constants_and_keyword_fields_are_attributes() -> None:
    assert TYPES.message("rosgraph_msgs/Log").new().ERROR == 8
    kind = TYPES.from_definition("mine/Keywords", "int8 from\nint8 class\n")
    assert kind.serialize(kind.new(**{"from": 1, "class_": 2})) == b"\x01\x02"
    assert kind.deserialize(b"\x01\x02").from_ == 1


@pytest.mark.parametrize(
    ("name", "values", "text"),
    [
        ("std_msgs/Header", {"seq": "a"}, "seq: 'a' is not a uint32"),
        ("std_msgs/Header", {"seq": -1}, "seq: -1 is out of the range of uint32"),
        ("std_msgs/Header", {"seq": 1.5}, "seq: 1.5 is not a uint32"),
        ("std_msgs/Header", {"seq": 10**5000}, "seq: an integer of 16610 bits is out of the range of uint32"),
        ("std_msgs/Header", {"stamp": 3}, "stamp: 3 is not a time"),
        ("std_msgs/Header", {"frame_id": b"x"}, "frame_id: b'x' is not a string"),
        ("std_msgs/Header", {"frame_id": "\ud800"}, "frame_id: cannot be written as UTF-8"),
        ("std_msgs/Bool", {"data": "yes"}, "data: 'yes' is not a bool"),
        ("std_msgs/Float32", {"data": 1e300}, r"data: 1e\+300 is out of the range of float32"),
        ("std_msgs/Int32MultiArray", {"data": [1, "a"]}, r"data\[1\]: 'a' is not a int32"),
        ("std_msgs/Int32MultiArray", {"data": 5}, r"data: 5 is not a int32\[\]"),
        ("std_msgs/UInt8MultiArray", {"data": 5}, r"data: 5 is not a uint8\[\]"),
        ("std_msgs/UInt8MultiArray", {"data": [1, 256]}, r"data\[1\]: 256 is out of the range of uint8"),
        ("geometry_msgs/PoseStamped", {"pose": {"position": {"x": "far"}}}, "pose.position.x: 'far' is not"),
        ("geometry_msgs/PoseArray", {"poses": [{}, {"position": 4}]}, r"poses\[1\].position: 4 is not a"),
        ("geometry_msgs/PoseArray", {"poses": [None]}, r"poses\[0\]: None is not a geometry_msgs/Pose"),
        ("geometry_msgs/PoseWithCovariance", {"covariance": [0.0] * 35}, "covariance: has 35 elements"),
        ("geometry_msgs/Pose", {"position": {"w": 1}}, "position.w: geometry_msgs/Point has no such field"),
    ],
)
def test_unfit_value_is_refused_by_its_field(name: str, values: Any, text: str) -> None:
    """A value that does not fit is refused by the name of its field."""
    with pytest.raises(SerializationError, match=text):
        TYPES.message(name).serialize(values)


@pytest.mark.parametrize(
    ("name", "payload", "text"),
    [
        (
            "std_msgs/String",
            b"\xff\xff\xff\xffabc",
            "data: the message ends after 7 bytes, 4294967292 are missing",
        ),
        ("std_msgs/String", b"\x02\0\0\0\xff", "data: the message ends after 5 bytes, 1 are missing"),
        ("std_msgs/String", b"\x01\0\0\0\xff\0", "std_msgs/String: 1 bytes too many"),
        ("geometry_msgs/PoseArray", bytes(16) + b"\xff" * 4, r"poses\[0\].position.x: the message ends"),
        ("sensor_msgs/Image", bytes(36) + b"\xff" * 4, "the message ends"),
        ("std_msgs/Empty", b"x", "std_msgs/Empty: 1 bytes too many"),
    ],
)
def test_a_wrong_buffer_is_refused_by_the_name_of_the_field(name: str, payload: bytes, text: str) -> None:
    with pytest.raises(SerializationError, match=text):
        TYPES.message(name).deserialize(payload)


def test_text_that_is_not_utf8_is_read_with_replacements(caplog: pytest.LogCaptureFixture) -> None:
    """As rospy does: a driver's text in Latin-1 does not cost the whole message. Logged once for the type."""
    text = b"\x04\0\0\0caf\xe9"
    kind = TYPES.from_definition(
        "mine/Texts",
        "string one\nstring[] many\nNested[] nested\nint8 last\n"
        f"{SEPARATOR}\nMSG: mine/Nested\nstring text\n",
    )
    payload = text + b"\x02\0\0\0" + text * 2 + b"\x01\0\0\0" + text + b"\x07"
    for _ in range(2):
        message = kind.deserialize(payload)
        assert (message.one, message.many) == ("caf\ufffd", ["caf\ufffd"] * 2)
        assert (message.nested[0].text, message.last) == ("caf\ufffd", 7)
    assert caplog.text.count("a string of a mine/Texts is not UTF-8") == 1
    with pytest.raises(SerializationError, match="last: the message ends"):
        kind.deserialize(payload[:-1])
    assert kind.deserialize(kind.serialize(message)).one == "caf\ufffd"


def test_cut_text_is_refused_and_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    kind = TYPES.from_definition("mine/Text", "string text\n")
    with pytest.raises(SerializationError, match="text: the message ends"):
        kind.deserialize(b"\x05\0\0\0caf\xc3")
    assert "UTF-8" not in caplog.text


def test_a_hostile_length_of_empty_messages_costs_nothing() -> None:
    kind = TYPES.from_definition("mine/Nothings", f"Nothing[] n\n{SEPARATOR}\nMSG: mine/Nothing\n")
    assert len(kind.deserialize(struct.pack("<I", 3)).n) == 3
    with pytest.raises(SerializationError, match="elements without content"):
        kind.deserialize(b"\xff" * 4)


def test_hostile_length_of_fixed_arrays_is_refused_unread(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of ``shape_msgs/Mesh``: beyond the end of a message, arrays of numbers are read without an error."""
    read: list[str] = []
    monkeypatch.setattr(objects, "unpack_numbers", lambda code, _: read.append(code))
    kind = TypeRegistry().from_definition(
        "mine/Mesh", f"Triangle[] t\n{SEPARATOR}\nMSG: mine/Triangle\nuint32[3] corners\n"
    )
    with pytest.raises(SerializationError, match=r"t\[2\].corners: the message ends after 28 bytes"):
        kind.deserialize(struct.pack("<I", 1000) + bytes(24))
    assert not read
    kind.deserialize(struct.pack("<I", 2) + bytes(24))
    assert len(read) == 2


def test_times_convert_and_compare() -> None:
    assert Time.from_sec(1.25) == Time(1, 250_000_000)
    assert Duration.from_sec(-0.5) == Duration(-1, 500_000_000)
    assert math.isclose(Duration(-1, 500_000_000).to_sec(), -0.5)
    assert Time(1, 0) < Time(1, 1) <= Time(2, 0)
    assert not Time()
    assert Time.now() > Time(1_600_000_000, 0)
    assert Time(1) != Duration(1)
