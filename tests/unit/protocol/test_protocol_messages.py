"""Typed messages from JSON text, and the words for what is wrong."""

from __future__ import annotations

import contextlib
import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.model import requests
from rce.model.faults import join_path
from rce.model.requests import AddNode, ConfigureComponents, Connection
from rce.model.specs import Network, NodeSpec, Resources
from rce.protocol import messages as m
from rce.protocol.codec import encode, encode_message
from rce.protocol.exceptions import MessageError
from rce.protocol.reading import decode
from rce.protocol.requests import read_request


def text(kind: str, data: object) -> str:
    return json.dumps({"type": kind, "data": data})


@pytest.mark.parametrize(
    ("kind", "data", "expected"),
    [
        ("CC", {"containerTag": "c"}, requests.CreateContainer(tag="c")),
        ("CC", {"containerTag": "c", "containerData": None}, requests.CreateContainer(tag="c")),
        (
            "CC",
            {
                "containerTag": "c",
                "containerData": {
                    "group": "g",
                    "groupIp": "10.0.0.1",
                    "size": 2,
                    "cpu": 1,
                    "memory": 1000,
                    "bandwidth": 5,
                    "specialFeatures": "gpu lidar",
                },
            },
            requests.CreateContainer(
                tag="c",
                resources=Resources(
                    group="g",
                    group_ip="10.0.0.1",
                    network=Network.GROUP,
                    size=2,
                    cpu=1.0,
                    memory=1000 << 20,
                    bandwidth=5,
                    special_features=("gpu", "lidar"),
                ),
            ),
        ),
        ("DC", {"containerTag": "c", "unknown": 1}, requests.DestroyContainer(tag="c")),
        (
            "CX",
            {"connect": [{"tagA": "c/i", "tagB": "r/j"}]},
            requests.ConfigureConnections(connect=(Connection(tag_a="c/i", tag_b="r/j"),)),
        ),
        (
            "DM",
            {"iTag": "i", "type": "a/B", "msgID": "7", "msg": {"data": [1, 2.5, None]}},
            m.DataMessage("i", "a/B", {"data": [1, 2.5, None]}, "7"),
        ),
        ("DM", {"iTag": "i", "type": "a/B", "msg": {}}, m.DataMessage("i", "a/B", {}, "nil")),
        ("ST", {"topic": "iu", "iTag": "i", "status": True}, m.InterfaceStatus(i_tag="i", status=True)),
        ("ER", "no", m.ErrorReport(problem="no")),
    ],
)
def test_message_is_read(kind: str, data: object, expected: m.ClientMessage) -> None:
    assert decode(text(kind, data)) == expected
    assert decode(text(kind, data).encode()) == expected


def test_features_are_words_or_a_list() -> None:
    for labels in ("gpu  lidar", ["gpu", "lidar"]):
        read = read_request("CC", {"containerTag": "c", "containerData": {"specialFeatures": labels}})
        assert read == requests.CreateContainer(
            tag="c", resources=Resources(special_features=("gpu", "lidar"))
        )


def test_components_are_read() -> None:
    node = {
        "containerTag": "c",
        "nodeTag": "n",
        "pkg": "Test",
        "exe": "stringEcho.py",
        "namespace": "/Robot1",
    }
    interface = {
        "endpointTag": "c",
        "interfaceTag": "i",
        "interfaceType": "PublisherInterface",
        "className": "std_msgs/String",
        "addr": "/topic",
    }
    parameter = {"containerTag": "c", "name": "a/b", "value": [1, 2.5, "x", True]}
    read = decode(
        text(
            "CN",
            {
                "addNodes": [node],
                "removeNodes": [{"containerTag": "c", "nodeTag": "n"}],
                "addInterfaces": [interface],
                "removeInterfaces": [{"endpointTag": "c", "interfaceTag": "i"}],
                "setParam": [parameter],
                "deleteParam": [{"containerTag": "c", "name": "/x"}],
            },
        )
    )
    assert isinstance(read, requests.ConfigureComponents)
    assert read.faults == ()
    assert read.add_nodes == (
        AddNode(container="c", node=NodeSpec(tag="n", pkg="Test", exe="stringEcho.py", namespace="/Robot1")),
    )
    assert read.add_interfaces[0].interface.addr == "/topic"
    assert read.set_param[0].parameter.value == [1, 2.5, "x", True]
    assert (len(read.remove_nodes), len(read.remove_interfaces), len(read.delete_param)) == (1, 1, 1)
    assert decode(str(encode(read)[0])) == read


def test_bad_items_are_reported_and_good_ones_kept() -> None:
    good = {"containerTag": "c", "nodeTag": "n", "pkg": "Test", "exe": "a.py"}
    data = {
        "addNodes": [good, 3, {**good, "pkg": "9"}, {**good, "exe": "../../bin/sh"}, {"containerTag": "c"}],
        "removeNodes": "all",
        "addInterfaces": [
            {
                "endpointTag": "c",
                "interfaceTag": "i",
                "interfaceType": "PublisherInterface",
                "className": "std_msgs/String",
            }
        ],
        "setParam": [{"containerTag": "c", "name": "p", "value": {"a": 1}}],
    }
    read = read_request("CN", data)
    assert isinstance(read, requests.ConfigureComponents)
    assert [add.node.tag for add in read.add_nodes] == ["n"]
    places = [join_path(fault.path) for fault in read.faults]
    assert places == [
        "data.addNodes[1]",
        "data.addNodes[2].pkg",
        "data.addNodes[3].exe",
        "data.addNodes[4].nodeTag",
        "data.removeNodes",
        "data.addInterfaces[0].addr",
        "data.setParam[0].value",
    ]
    assert "a package's name (letters, digits and '_', a letter first)" in read.faults[1].problem


def test_bad_connection_is_reported_and_the_good_one_kept() -> None:
    read = read_request("CX", {"connect": [{"tagA": "ri", "tagB": "c/j"}, {"tagA": "r/i", "tagB": "c/j"}]})
    assert isinstance(read, requests.ConfigureConnections)
    assert read.connect == (Connection(tag_a="r/i", tag_b="c/j"),)
    assert [str(fault) for fault in read.faults] == [
        "data.connect[0].tagA: must have the form ENDPOINT/INTERFACE, not 'ri'"
    ]


@pytest.mark.parametrize(
    ("frame", "problem"),
    [
        ("", "not valid JSON"),
        ("{", "not valid JSON"),
        ('{"type": "DM"} x', "not valid JSON"),
        ('"\ud800"', "not valid JSON"),
        (b"\xff", "not valid JSON"),
        ('{"type": "CC", "data": Infinity', "not valid JSON"),
        ("[]", "a message must be an object, not a list"),
        ("null", "a message must be an object, not null"),
        ("{}", "type: is missing"),
        ('{"type": 3, "data": {}}', "type: unknown message type 3"),
        ('{"type": ["DM"], "data": {}}', "type: unknown message type"),
        ('{"type": "XX", "data": {}}', "type: unknown message type 'XX'; use one of CC, CN, CX"),
        ('{"type": "CC"}', "data: is missing"),
        ('{"type": "CC", "data": "c"}', "data: must be an object, not a string"),
        ('{"type": "CC", "data": {}}', "data.containerTag: is missing"),
        ('{"type": "CC", "data": {"containerTag": "a b"}}', "data.containerTag: must be a name"),
        ('{"type": "CC", "data": {"containerTag": "a\\n"}}', "data.containerTag: must be a name"),
        ('{"type": "DC", "data": {"containerTag": 3}}', "data.containerTag: must be str, not int"),
        (text("CC", {"containerTag": "a", "containerData": {"cpu": -1}}), "data.containerData.cpu: must be"),
        (text("DC", {"containerTag": "a" * 129}), "data.containerTag: must be str of length <= 128"),
        (
            text("DM", {"iTag": "i", "type": "a/B", "msg": 1, "msgID": "x" * 256}),
            "data.msgID: must be str of",
        ),
        (
            text("DM", {"iTag": "i", "type": "aB", "msg": 1}),
            "data.type: must be a class of the form package/Type",
        ),
        (text("DM", {"iTag": "i", "type": "a/B"}), "data.msg: is missing"),
        (text("DM", [1]), "data: must be object"),
        (text("ER", {}), "data: must be str"),
        ("[" * 100_000, "nested deeper"),
        (
            text("DM", {"iTag": "i", "type": "a/B", "msg": json.loads("[" * 63 + "]" * 63)}),
            "nested deeper than 64",
        ),
    ],
)
def test_wrong_message_is_refused_with_its_place(frame: str | bytes, problem: str) -> None:
    with pytest.raises(MessageError) as caught:
        decode(frame)
    assert str(caught.value).startswith(problem)


def test_nesting_within_limit_is_fine_among_brackets() -> None:
    """Nesting within the limit is fine even among many brackets."""
    msg = {"deep": json.loads("[" * 61 + "]" * 61), "wide": [[] for _ in range(1000)]}
    assert decode(text("DM", {"iTag": "i", "type": "a/B", "msg": msg})) == m.DataMessage("i", "a/B", msg)


def test_depth_is_found_behind_brackets_in_a_long_text() -> None:
    msg = {"a": "x" * 5000, "b": json.loads("[" * 64 + "]" * 64)}
    with pytest.raises(MessageError, match="nested deeper"):
        decode(text("DM", {"iTag": "i", "type": "a/B", "msg": msg}))


def test_nan_of_python_writers_is_understood() -> None:
    read = decode('{"type":"DM","data":{"iTag":"i","type":"a/B","msg":{"ranges":[Infinity,1.0]}}}')
    assert isinstance(read, m.DataMessage)
    assert read.msg == {"ranges": [float("inf"), 1.0]}


@pytest.mark.parametrize("exe", ["a.py", "sub/a.py", "a..b", "..a"])
def test_executable_inside_the_package_is_allowed(exe: str) -> None:
    node = {"containerTag": "c", "nodeTag": "n", "pkg": "Test", "exe": exe}
    request = read_request("CN", {"addNodes": [node]})
    assert isinstance(request, ConfigureComponents)
    assert request.add_nodes[0].node.exe == exe


@pytest.mark.parametrize("exe", ["", "/bin/sh", "..", "../a", "a/..", "a/../../b", "a\0b", "a\n"])
def test_executable_outside_the_package_is_refused(exe: str) -> None:
    node = {"containerTag": "c", "nodeTag": "n", "pkg": "Test", "exe": exe}
    request = read_request("CN", {"addNodes": [node]})
    assert isinstance(request, ConfigureComponents)
    assert request.faults


def test_unknown_request_type_is_refused() -> None:
    with pytest.raises(MessageError, match="'DM' is not a request; use one of CC, DC, CN, CX"):
        read_request("DM", {})


NAMES = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,20}", fullmatch=True)
JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(codec="utf-8")),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(st.characters(codec="utf-8")), inner, max_size=4)
    ),
    max_leaves=20,
)


@given(NAMES, NAMES, JSON, st.text(st.characters(codec="utf-8"), max_size=255))
def test_data_message_survives_the_round_trip(tag: str, cls: str, msg: object, msg_id: str) -> None:
    message = m.DataMessage(tag, f"pkg/{cls}", msg, msg_id)
    (frame,) = encode(message)
    assert decode(str(frame)) == message


@given(st.sampled_from(["CC", "DC", "CN", "CX", "DM", "ST", "ER", "XX"]), JSON)
def test_any_data_is_a_message_or_an_error_with_words(kind: str, data: object) -> None:
    (frame,) = encode_message(kind, data)
    with contextlib.suppress(MessageError):
        assert m.type_of(decode(str(frame))) == kind


@given(
    st.dictionaries(
        st.sampled_from(["addNodes", "addInterfaces", "setParam", "connect"]), JSON | st.lists(JSON)
    )
)
def test_any_items_are_read_or_reported(data: Any) -> None:
    for kind in ("CN", "CX"):
        read = read_request(kind, data)
        assert isinstance(read, requests.ConfigureComponents | requests.ConfigureConnections)
        given_items = sum(
            len(items)
            for key, items in data.items()
            if isinstance(items, list) and (key == "connect") == (kind == "CX")
        )
        kept = (
            len(read.connect)
            if isinstance(read, requests.ConfigureConnections)
            else len(read.add_nodes) + len(read.add_interfaces) + len(read.set_param)
        )
        assert kept + len(read.faults) >= given_items or len(read.faults) > 31


@given(st.text() | st.binary())
def test_garbage_is_a_message_error(garbage: str | bytes) -> None:
    with pytest.raises(MessageError):
        decode(garbage)
