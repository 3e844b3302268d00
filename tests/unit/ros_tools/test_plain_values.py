"""Messages as plain values, values from a command line, rates, and which container is meant."""

from __future__ import annotations

import json

import pytest
import typer

from rce.ros.tools.plain import as_json, as_yaml, plain, read_fields, read_value
from rce.ros.tools.topics import Rate
from rce.ros.types import TypeRegistry
from rce_master.cli.graph import Target, split

TYPES = TypeRegistry()


def test_nested_messages_and_times_are_plain() -> None:
    kind = TYPES.message("std_msgs/Header")
    message = kind.new(seq=3, frame_id="map")
    assert plain(message) == {"seq": 3, "stamp": {"secs": 0, "nsecs": 0}, "frame_id": "map"}
    assert read_value(as_yaml(message)) == plain(message)
    assert json.loads(as_json(message)) == plain(message)


def test_long_arrays_are_cut_for_people_only() -> None:
    scan = TYPES.message("sensor_msgs/LaserScan").new(ranges=[1.5] * 100)
    assert "... 36 more" in as_yaml(scan)
    assert len(read_value(as_yaml(scan, whole=True))["ranges"]) == 100
    assert "1.5" not in as_yaml(scan, arrays=False)
    assert len(json.loads(as_json(scan))["ranges"]) == 100


def test_json_has_no_nan_and_bytes_are_base64() -> None:
    message = TYPES.message("std_msgs/Float64").new(data=float("nan"))
    assert json.loads(as_json(message)) == {"data": None}
    image = TYPES.message("sensor_msgs/CompressedImage").new(data=b"\x00\xff")
    assert json.loads(as_json(image))["data"] == "AP8="


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        ("", {}),
        ("{x: 1, z: 2.5}", {"x": 1, "z": 2.5}),
        ("[1, 2, 3]", {"x": 1, "y": 2, "z": 3}),
    ],
)
def test_fields_come_as_mapping_or_in_order(text: str, fields: dict[str, float]) -> None:
    assert read_fields(text, TYPES.message("geometry_msgs/Vector3")) == fields


def test_a_single_field_needs_no_name() -> None:
    assert read_fields("hello", TYPES.message("std_msgs/String")) == {"data": "hello"}
    assert read_fields("[1, 2]", TYPES.message("tf2_msgs/TFMessage")) == {"transforms": [1, 2]}


@pytest.mark.parametrize(("text", "words"), [("[1, 2]", "3 fields"), ("5", "x, y, z"), ("{", "not a YAML")])
def test_values_that_do_not_fit_say_what_was_expected(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        read_fields(text, TYPES.message("geometry_msgs/Vector3"))


def test_a_rate_is_that_of_the_last_messages() -> None:
    rate = Rate(3)
    assert rate.describe() == ""
    for now in (0.0, 5.0, 5.1, 5.2):
        rate.note(now)
    assert rate.describe().startswith("average rate: 10.000 Hz, gaps min 0.1000 s max 0.1000 s")
    assert rate.describe().endswith("window 3")


@pytest.mark.parametrize(
    ("arguments", "target"),
    [
        (["list", "-v"], Target("", "", ("list", "-v"))),
        (["-c", "box", "echo", "/x"], Target("box", "", ("echo", "/x"))),
        (["echo", "/x", "--container=box", "--user", "ann"], Target("box", "ann", ("echo", "/x"))),
        (["pub", "/x", "T", "--", "-c"], Target("", "", ("pub", "/x", "T", "--", "-c"))),
    ],
)
def test_the_container_is_taken_out_of_the_arguments(arguments: list[str], target: Target) -> None:
    assert split(arguments) == target


def test_a_container_that_is_not_named_is_asked_for() -> None:
    with pytest.raises(typer.BadParameter, match="-c needs a value"):
        split(["list", "-c"])
