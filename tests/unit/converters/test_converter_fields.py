"""The JSON form of messages: what is taken, what is refused and by which name, what leaves."""

import base64
import math
import struct
from datetime import datetime
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.ros.types import Field, MessageType, TypeRegistry
from rce.ros.types.values import NUMBERS
from rce_robot.converters import ConversionError, Converter, Converters

TYPES = TypeRegistry()
SEPARATOR = "=" * 80
SHAPES = ("{} {}", "{}[] {}s", "{}[3] three_{}")
EVERYTHING = TYPES.from_definition(
    "mine/Everything",
    "".join(
        shape.format(name, f"f_{name}") + "\n"
        for name in (*NUMBERS, "string", "time", "duration", "Inner")
        for shape in SHAPES
    )
    + f"{SEPARATOR}\nMSG: mine/Inner\nuint8 a\nstring b\nfloat64 c\nInnermost[] d\n\n"
    + f"{SEPARATOR}\nMSG: mine/Innermost\nint16 e\n",
)
CONVERTERS = Converters()
EPOCH, LAST = datetime(1970, 1, 1), datetime(2106, 1, 1)  # noqa: DTZ001


def converter(name: str) -> Converter:
    return CONVERTERS.of(TYPES.message(name))


def json_elements(field: Field) -> st.SearchStrategy[Any]:
    if field.message is not None:
        return json_objects(field.message)
    if field.type in NUMBERS:
        return numbers(field.type)
    moments = st.datetimes(min_value=EPOCH, max_value=LAST)
    return {
        "string": st.text(),
        "time": moments.map(lambda moment: moment.isoformat(timespec="microseconds")),
        "duration": st.integers(-(10**12), 10**12).map(lambda us: us / 1_000_000),
    }[field.type]


def numbers(name: str) -> st.SearchStrategy[Any]:
    number = NUMBERS[name]
    if name == "bool":
        return st.booleans()
    if number.is_float:
        return st.floats(width=32 if number.size == 4 else 64, allow_nan=False, allow_infinity=False)
    return st.integers(number.low, number.high)


def json_objects(kind: MessageType) -> st.SearchStrategy[Any]:
    fields: dict[str, st.SearchStrategy[Any]] = {}
    for field in kind.fields:
        size = (0, 4) if field.length is None else (field.length, field.length)
        if field.is_bytes:
            fields[field.name] = st.binary(min_size=size[0], max_size=size[1])
        elif field.is_array:
            fields[field.name] = st.lists(json_elements(field), min_size=size[0], max_size=size[1])
        else:
            fields[field.name] = json_elements(field)
    return st.fixed_dictionaries(fields)


OBJECTS = json_objects(EVERYTHING)  # made once: there are many strategies in it


@given(OBJECTS)
def test_every_field_type_comes_back_as_it_went(value: object) -> None:
    codec = CONVERTERS.of(EVERYTHING)
    payload, unknown = codec.decode(value)
    assert unknown == ()
    assert codec.encode(payload) == value
    # The bytes are those of the message objects' codec, which rosbags agrees with.
    assert EVERYTHING.serialize(EVERYTHING.deserialize(payload)) == payload


@given(OBJECTS)
def test_values_survive_json_with_base64_binaries(value: object) -> None:
    """Values survive json text with base64 in place of binary values."""
    codec = CONVERTERS.of(EVERYTHING)
    payload, _ = codec.decode(value)
    assert codec.decode(msgspec.json.decode(msgspec.json.encode(value)))[0] == payload


@given(st.data())
def test_any_part_of_the_fields_may_be_missing(data: st.DataObject) -> None:
    full = data.draw(OBJECTS)
    kept = {key: full[key] for key in data.draw(st.sets(st.sampled_from(sorted(full))))}
    payload, unknown = CONVERTERS.of(EVERYTHING).decode(kept)
    assert unknown == ()
    decoded = CONVERTERS.of(EVERYTHING).encode(payload)
    default = CONVERTERS.of(EVERYTHING).encode(EVERYTHING.serialize(EVERYTHING.new()))
    assert decoded == {**default, **kept}


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@given(st.data(), JSON_VALUES)
def test_strange_value_is_taken_or_refused_by_name(data: st.DataObject, strange: object) -> None:
    """A strange value in any field is taken or refused by name."""
    field = data.draw(st.sampled_from(EVERYTHING.fields))
    codec = CONVERTERS.of(EVERYTHING)
    try:
        payload, _ = codec.decode({field.name: strange})
    except ConversionError as error:
        assert error.field.startswith(field.name)  # noqa: PT017
        msgspec.json.encode(str(error))
    else:
        codec.encode(payload)


@given(st.binary(max_size=200))
def test_garbage_bytes_are_read_or_refused(data: bytes) -> None:
    for name in ("nav_msgs/Path", "std_msgs/Int32MultiArray", "sensor_msgs/Image"):
        try:
            converter(name).encode(data)
        except ConversionError as error:
            assert error.reason  # noqa: PT017


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("std_msgs/Header", {"seq": "a"}, "seq: 'a' is not a uint32"),
        ("std_msgs/Header", {"seq": "1"}, "seq: '1' is not a uint32"),
        ("std_msgs/Header", {"seq": -1}, "seq: -1 is out of the range of uint32"),
        ("std_msgs/Header", {"seq": 2**32}, "seq: 4294967296 is out of the range of uint32"),
        ("std_msgs/Header", {"seq": 1.5}, "seq: 1.5 is not a uint32"),
        ("std_msgs/Header", {"seq": True}, "seq: true is not a uint32"),
        ("std_msgs/Header", {"seq": None}, "seq: null is not a uint32"),
        ("std_msgs/Header", {"frame_id": 1}, "frame_id: 1 is not a string"),
        ("std_msgs/Header", {"frame_id": b"x"}, "frame_id: a binary value is not a string"),
        ("std_msgs/Header", {"stamp": 1.5}, "stamp: 1.5 is not a time"),
        ("std_msgs/Header", {"stamp": "noon"}, "stamp: 'noon' is not an ISO 8601 time"),
        (
            "std_msgs/Header",
            {"stamp": "1969-12-31T23:59:59"},
            "stamp: '1969-12-31T23:59:59' is out of the range",
        ),
        ("std_msgs/Header", {"stamp": {"secs": -1}}, "stamp: secs of a time is -1"),
        ("std_msgs/Header", {"stamp": {"sec": 1}}, "stamp: an object that is a time has secs and nsecs"),
        ("std_msgs/Duration", {"data": "1"}, "data: '1' is not a duration"),
        ("std_msgs/Duration", {"data": True}, "data: true is not a duration"),
        ("std_msgs/Duration", {"data": 1e10}, "data: 10000000000.0 is out of the range of duration"),
        ("std_msgs/Duration", {"data": math.inf}, "data: inf is not a duration"),
        ("std_msgs/Bool", {"data": 1}, "data: 1 is not a bool"),
        ("std_msgs/Float32", {"data": "1"}, "data: '1' is not a float32"),
        ("std_msgs/Float32", {"data": True}, "data: true is not a float32"),
        ("std_msgs/Float32", {"data": 1e300}, r"data: 1e\+300 is out of the range of float32"),
        (
            "std_msgs/Float64",
            {"data": 10**400},
            "data: an integer of 1329 bits is out of the range of float64",
        ),
        ("std_msgs/Int32MultiArray", {"data": [1, "a"]}, r"data\[1\]: 'a' is not a int32"),
        ("std_msgs/Int32MultiArray", {"data": [1, True]}, r"data\[1\]: true is not a int32"),
        (
            "std_msgs/Int32MultiArray",
            {"data": [2**31]},
            r"data\[0\]: 2147483648 is out of the range of int32",
        ),
        ("std_msgs/Int32MultiArray", {"data": "AAAA"}, r"data: 'AAAA' is not a int32\[\] \(a list\)"),
        ("std_msgs/Int32MultiArray", {"data": {}}, r"data: an object is not a int32\[\] \(a list\)"),
        ("std_msgs/UInt8MultiArray", {"data": "no base64!"}, r"data: 'no base64!' is not a uint8\[\]"),
        ("std_msgs/UInt8MultiArray", {"data": [256]}, r"data\[0\]: 256 is out of the range of uint8"),
        ("std_msgs/UInt8MultiArray", {"data": 3}, r"data: 3 is not a uint8\[\]"),
        ("std_msgs/String", ["x"], "std_msgs/String: a list is not an object"),
        ("std_msgs/String", b"x", "std_msgs/String: a binary value is not an object"),
        ("geometry_msgs/PoseStamped", {"header": {"seq": "a"}}, "header.seq: 'a' is not a uint32"),
        ("geometry_msgs/PoseStamped", {"header": None}, "header: null is not an object"),
        ("geometry_msgs/PoseStamped", {"pose": {"position": 1}}, "pose.position: 1 is not an object"),
        (
            "geometry_msgs/PoseArray",
            {"poses": [{}, {"position": {"x": "0"}}]},
            r"poses\[1\].position.x: '0' is not",
        ),
        (
            "geometry_msgs/PoseWithCovariance",
            {"covariance": [0.0] * 35},
            r"covariance: has 35 elements, float64\[36\]",
        ),
    ],
)
def test_what_does_not_fit_is_refused_by_the_name_of_its_field(name: str, value: object, text: str) -> None:
    with pytest.raises(ConversionError, match=text):
        converter(name).decode(value)


def test_fixed_octets_are_taken_in_three_forms() -> None:
    """Fixed octets are taken in three forms of the right length."""
    codec = CONVERTERS.of(TYPES.from_definition("mine/Id", "uint8[4] id\nchar[] more\n"))
    id_alone = CONVERTERS.of(TYPES.from_definition("mine/Alone", "uint8[4] id\n"))
    id_first = CONVERTERS.of(TYPES.from_definition("mine/First", "char[4] id\nuint8 number\n"))
    id_twice = CONVERTERS.of(TYPES.from_definition("mine/Twice", "uint8[4] id\nuint8[4] more\n"))
    for form in (b"abcd", bytearray(b"abcd"), memoryview(b"abcd"), "YWJjZA==", [97, 98, 99, 100]):
        assert codec.decode({"id": form, "more": form})[0] == b"abcd\x04\0\0\0abcd"
        alone = id_alone.decode({"id": form})[0]
        first = id_first.decode({"id": form, "number": 101})[0]
        twice = id_twice.decode({"id": form, "more": form})[0]
        assert (alone, first, twice) == (b"abcd", b"abcde", b"abcdabcd")
        assert {type(alone), type(first), type(twice)} == {bytes}
    for form in (b"abc", "YWJj", [1, 2, 3]):
        with pytest.raises(ConversionError, match=r"id: has 3 elements, uint8\[4\] has 4"):
            codec.decode({"id": form})


def test_octets_leave_as_views_of_the_message() -> None:
    payload = bytearray(b"\x03\0\0\0abc")
    value = CONVERTERS.of(TYPES.from_definition("mine/Raw", "uint8[] data\n")).encode(payload)
    assert isinstance(value["data"], memoryview)
    payload[4:5] = b"x"
    assert bytes(value["data"]) == b"xbc"


def test_unknown_fields_are_ignored_and_told_once() -> None:
    value = {
        "header": {"seq": 1, "colour": "red"},
        "poses": [{"pose": {"size": 1}}, {"pose": {"size": 2}, "name": "x"}],
        "x": None,
    }
    payload, unknown = converter("nav_msgs/Path").decode(value)
    assert unknown == ("header.colour", "poses[].pose.size", "poses[].name", "x")
    assert payload == converter("nav_msgs/Path").decode({"header": {"seq": 1}, "poses": [{}, {}]})[0]


def test_an_unknown_field_in_place_of_a_missing_one_is_told() -> None:
    assert converter("std_msgs/String").decode({"dta": "x"}) == (b"\0\0\0\0", ("dta",))


def test_integers_of_64_bits_are_exact() -> None:
    codec = converter("std_msgs/UInt64")
    for number in (2**64 - 1, 2**53 + 1):
        assert codec.encode(codec.decode({"data": number})[0]) == {"data": number}
    assert converter("std_msgs/Int64").decode({"data": -(2**63)})[0] == struct.pack("<q", -(2**63))


def test_an_integer_is_a_float_and_null_is_not_a_number() -> None:
    codec = converter("std_msgs/Float64")
    assert codec.encode(codec.decode({"data": 3})[0]) == {"data": 3.0}
    assert math.isnan(codec.encode(codec.decode({"data": None})[0])["data"])
    ranges = converter("sensor_msgs/LaserScan").decode({"ranges": [1, None, 2.5]})[0]
    back = converter("sensor_msgs/LaserScan").encode(ranges)["ranges"]
    assert (back[0], math.isnan(back[1]), back[2]) == (1.0, True, 2.5)


def test_nan_and_infinity_become_null_in_json_text() -> None:
    codec = converter("std_msgs/Float32MultiArray")
    value = codec.encode(codec.decode({"data": [math.nan, math.inf, 1.0]})[0])
    assert msgspec.json.decode(msgspec.json.encode(value["data"])) == [None, None, 1.0]


@pytest.mark.parametrize(
    ("value", "secs", "nsecs"),
    [
        ("2013-09-02T12:00:00.000001", 1378123200, 1000),
        ("2013-09-02T12:00:00Z", 1378123200, 0),
        ("2013-09-02T14:00:00.5+02:00", 1378123200, 500_000_000),
        ("1970-01-01T00:00:00", 0, 0),
        ("2106-02-07T06:28:15.999999", 2**32 - 1, 999_999_000),
        ({"secs": 5, "nsecs": 7}, 5, 7),
        ({"nsecs": 7}, 0, 7),
        ({}, 0, 0),
    ],
)
def test_times_are_taken_as_text_and_as_parts(value: object, secs: int, nsecs: int) -> None:
    assert converter("std_msgs/Time").decode({"data": value})[0] == struct.pack("<II", secs, nsecs)


@pytest.mark.parametrize(
    ("secs", "nsecs", "text"),
    [
        (0, 0, "1970-01-01T00:00:00.000000"),
        (1378123200, 1999, "2013-09-02T12:00:00.000001"),
        (1378123199, 1_000_000_000, "2013-09-02T12:00:00.000000"),
        (2**32 - 1, 2**32 - 1, "2106-02-07T06:28:19.294967"),
    ],
)
def test_times_leave_as_text_with_microseconds(secs: int, nsecs: int, text: str) -> None:
    assert converter("std_msgs/Time").encode(struct.pack("<II", secs, nsecs)) == {"data": text}


@pytest.mark.parametrize(
    ("value", "secs", "nsecs"),
    [
        (2, 2, 0),
        (1.5, 1, 500_000_000),
        (-0.25, -1, 750_000_000),
        (0.9999999999, 1, 0),
        ({"secs": -1, "nsecs": 5}, -1, 5),
    ],
)
def test_durations_are_seconds(value: object, secs: int, nsecs: int) -> None:
    payload = converter("std_msgs/Duration").decode({"data": value})[0]
    assert payload == struct.pack("<ii", secs, nsecs)
    assert math.isclose(converter("std_msgs/Duration").encode(payload)["data"], secs + nsecs / 1e9)


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        (b"\x04\0\0\0abc", "data: the message ends after 7 bytes, 1 are missing"),
        (b"\x01\0\0\0abc", "std_msgs/String: 2 bytes too many"),
        (b"\x05\0\0\0\xffabc", "data: the message ends after 8 bytes, 1 are missing"),
    ],
)
def test_bytes_that_are_no_message_are_refused(payload: bytes, text: str) -> None:
    with pytest.raises(ConversionError, match=text):
        converter("std_msgs/String").encode(payload)


def test_text_that_is_not_utf8_leaves_with_replacements(caplog: pytest.LogCaptureFixture) -> None:
    """A driver's text in Latin-1 does not cost the whole message; the first one of a type is logged."""
    payload = b"\x04\0\0\0caf\xe9"
    made = Converter(TYPES.message("std_msgs/String"), {})
    for _ in range(2):
        assert made.encode(payload) == {"data": "caf\ufffd"}
    assert caplog.text.count("a string of a std_msgs/String is not UTF-8") == 1


def test_services_are_converted_by_their_two_types() -> None:
    service = TYPES.service("rospy_tutorials/AddTwoInts")
    assert CONVERTERS.of(service.request).decode({"a": 1, "b": 2})[0] == struct.pack("<qq", 1, 2)
    assert CONVERTERS.of(service.response).encode(struct.pack("<q", 3)) == {"sum": 3}


class _Reversed:
    """A custom converter: a string travels backwards, as a binary value."""

    def encode(self, fields: Any) -> Any:
        return fields["data"][::-1].encode()

    def decode(self, value: object) -> Any:
        if not isinstance(value, bytes):
            raise ValueError("must be a binary value")  # noqa: TRY004
        return {"data": bytes(value).decode()[::-1]}


def test_a_custom_converter_works_wherever_its_class_stands() -> None:
    customs = {"std_msgs/String": _Reversed()}
    kind = TYPES.from_definition(
        "mine/Strings",
        f"std_msgs/String one\nstd_msgs/String[] many\n{SEPARATOR}\nMSG: std_msgs/String\nstring data\n",
    )
    codec = Converter(kind, customs)
    payload, unknown = codec.decode({"one": b"abc", "many": [b"de", {"data": "fg"}, {}]})
    assert unknown == ()
    assert payload == kind.serialize({"one": {"data": "cba"}, "many": [{"data": "ed"}, {"data": "fg"}, {}]})
    assert codec.encode(payload) == {"one": b"abc", "many": [b"de", b"gf", b""]}
    assert codec.is_costly
    with pytest.raises(ConversionError, match=r"many\[0\]: must be a binary value"):
        codec.decode({"many": [3]})
    alone = Converter(TYPES.message("std_msgs/String"), customs)
    assert alone.decode(b"abc")[0] == b"\x03\0\0\0cba"
    assert alone.encode(b"\x03\0\0\0cba") == b"abc"


def test_base64_is_what_the_wire_has() -> None:
    octets = bytes(range(256))
    codec = converter("std_msgs/UInt8MultiArray")
    payload = codec.decode({"data": base64.b64encode(octets).decode()})[0]
    assert codec.encode(payload)["data"] == octets


@pytest.mark.parametrize(
    ("name", "value", "same"),
    [
        ("std_msgs/Int32", {"data": 3.0}, {"data": 3}),
        ("std_msgs/Int64", {"data": -1e15}, {"data": -(10**15)}),
        ("std_msgs/UInt8", {"data": -0.0}, {"data": 0}),
        ("std_msgs/Int32MultiArray", {"data": [1, 2.0, -3e0]}, {"data": [1, 2, -3]}),
        ("std_msgs/UInt8MultiArray", {"data": [1.0, 255.0]}, {"data": [1, 255]}),
        ("std_msgs/Time", {"data": {"secs": 5.0, "nsecs": 7.0}}, {"data": {"secs": 5, "nsecs": 7}}),
        ("geometry_msgs/PoseStamped", {"header": {"seq": 9.0}}, {"header": {"seq": 9}}),
    ],
)
def test_numbers_without_fraction_are_integers(name: str, value: object, same: object) -> None:
    assert converter(name).decode(value) == converter(name).decode(same)


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("std_msgs/Int32", {"data": 3.5}, "data: 3.5 is not a int32"),
        ("std_msgs/Int32", {"data": 3e9}, "data: 3000000000 is out of the range of int32"),
        ("std_msgs/Int64", {"data": math.inf}, "data: inf is not a int64"),
        ("std_msgs/Int64", {"data": math.nan}, "data: nan is not a int64"),
        ("std_msgs/Int32MultiArray", {"data": [1.0, 2.5]}, r"data\[1\]: 2.5 is not a int32"),
        ("std_msgs/UInt8MultiArray", {"data": [256.0]}, r"data\[0\]: 256 is out of the range of uint8"),
        ("std_msgs/Bool", {"data": 1.0}, "data: 1.0 is not a bool"),
        ("std_msgs/Time", {"data": {"secs": 1.5}}, "data: secs of a time is 1.5"),
    ],
)
def test_numbers_with_fraction_are_refused_as_integers(name: str, value: object, text: str) -> None:
    with pytest.raises(ConversionError, match=text):
        converter(name).decode(value)
