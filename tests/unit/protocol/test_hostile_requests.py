"""Requests that would harm others if they were let through."""

from __future__ import annotations

import json

import pytest

from rce.model.requests import ConfigureComponents
from rce.protocol.exceptions import MessageError
from rce.protocol.limits import Limits
from rce.protocol.messages import DataMessage
from rce.protocol.reading import decode
from rce.protocol.requests import read_request
from rce.protocol.stream import Fault, ProtocolStream


@pytest.mark.parametrize("cpu", [float("inf"), float("nan"), 1e300, -1.0])
def test_cores_must_be_a_number_that_json_can_hold(cpu: float) -> None:
    with pytest.raises(MessageError, match=r"data\.containerData\.cpu"):
        read_request("CC", {"containerTag": "c", "containerData": {"cpu": cpu}})


@pytest.mark.parametrize("value", ["NaN", "-Infinity", "[1, NaN]", "2147483648", "1" + 4000 * "0"])
def test_parameters_must_be_numbers_that_json_and_ros_can_hold(value: str) -> None:
    """JSON would carry ``null`` in place of NaN to the master, which takes that for garbage."""
    text = '{"type": "CN", "data": {"setParam": [{"containerTag": "c", "name": "p", "value": VALUE}]}}'
    request = decode(text.replace("VALUE", value))
    assert isinstance(request, ConfigureComponents)
    assert not request.set_param
    (fault,) = request.faults
    assert str(fault).startswith("data.setParam[0].value: must ")


@pytest.mark.parametrize("half", [r"\ud800", r"\uDFFF", r"x\uD83D"])
def test_half_a_character_is_refused_beside_a_nan_too(half: str) -> None:
    text = '{"type": "CN", "data": {"x": NaN, "deleteParam": [{"containerTag": "c", "name": "HALF"}]}}'
    text = text.replace("HALF", half)
    for frame in (text, text.encode()):
        with pytest.raises(MessageError, match="not valid JSON"):
            decode(frame)


def test_a_whole_character_in_two_escapes_is_read_beside_a_nan() -> None:
    message = decode(
        r'{"type": "DM", "data": {"iTag": "i", "type": "a/B", "msg": {"a": NaN, "b": "\ud83d\ude00"}}}'
    )
    assert isinstance(message, DataMessage)
    assert message.msg["b"] == "\U0001f600"


def test_long_request_is_refused_long_data_is_not() -> None:
    """A request that is too long is refused and a data message is not."""
    stream = ProtocolStream.for_engine(Limits(max_request=1000))
    item = {"containerTag": "c", "name": "p", "value": "x" * 1000}
    (fault,) = stream.feed(json.dumps({"type": "CN", "data": {"setParam": [item]}}), 0.0)
    assert isinstance(fault, Fault)
    assert "longer than the limit of 1000" in fault.text
    data = {"iTag": "i", "type": "a/B", "msg": {"data": "x" * 2000}}
    (message,) = stream.feed(json.dumps({"type": "DM", "data": data}), 0.0)
    assert isinstance(message, DataMessage)
    (message,) = stream.feed(json.dumps({"type": "CN", "data": {}}), 0.0)
    assert isinstance(message, ConfigureComponents)
