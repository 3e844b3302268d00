"""What an ``ER`` tells people, and programs."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.model import FaultCode, FieldFault
from rce.protocol.codec import encode
from rce.protocol.messages import CallId, ErrorReport
from rce.protocol.reading import decode
from rce.protocol.reports import read_report
from rce.protocol.stream import Fault, ProtocolStream

CALL = CallId("ask", "call7")


@pytest.mark.parametrize(
    ("report", "wire"),
    [
        (ErrorReport(problem="no room"), {"type": "ER", "data": "no room"}),
        (
            ErrorReport(problem="no answer", call=CALL),
            {
                "type": "ER",
                "data": "ask, msgID call7: no answer",
                "fault": {"iTag": "ask", "msgID": "call7"},
            },
        ),
        (
            ErrorReport(problem="data.x: is missing", path=("data", "x"), code=FaultCode.MISSING),
            {
                "type": "ER",
                "data": "data.x: is missing",
                "fault": {"code": "missing", "path": ["data", "x"]},
            },
        ),
        (
            ErrorReport(
                problem="a: is missing; b: is over 3",
                path=("a",),
                code=FaultCode.MISSING,
                faults=(
                    FieldFault(("a",), FaultCode.MISSING, "is missing"),
                    FieldFault(("b", 0), FaultCode.LIMIT, "is over 3"),
                ),
            ),
            {
                "type": "ER",
                "data": "a: is missing; b: is over 3",
                "fault": {
                    "code": "missing",
                    "path": ["a"],
                    "faults": [
                        {"code": "missing", "path": ["a"], "problem": "is missing"},
                        {"code": "limit", "path": ["b", 0], "problem": "is over 3"},
                    ],
                },
            },
        ),
        (
            ErrorReport(problem="DC: no", code=FaultCode.NOT_FOUND, ids={"containerTag": "c"}),
            {
                "type": "ER",
                "data": "DC: no",
                "fault": {"code": "not_found", "path": [], "ids": {"containerTag": "c"}},
            },
        ),
    ],
)
def test_report_returns_from_the_wire(report: ErrorReport, wire: dict[str, Any]) -> None:
    (frame,) = encode(report)
    assert json.loads(frame) == wire
    assert decode(str(frame)) == report


def test_report_of_an_older_engine_has_its_text_only() -> None:
    text = "ask, msgID call7: no answer"
    assert decode(json.dumps({"type": "ER", "data": text})) == ErrorReport(problem=text)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
KEYS = ["code", "path", "iTag", "msgID", "faults", "ids"]


@given(JSON | st.dictionaries(st.sampled_from(KEYS), JSON))
def test_report_with_any_data_keeps_its_text(fault: Any) -> None:
    """A later engine may say more, or something else."""
    assert read_report("no room", fault).text.endswith("no room")


def test_fault_in_a_request_has_its_path_and_code() -> None:
    stream = ProtocolStream.for_engine()
    text = json.dumps({"type": "CC", "data": {"containerTag": "c", "containerData": {"cpu": "half"}}})
    (fault,) = stream.feed(text, 0.0)
    assert isinstance(fault, Fault)
    assert fault.report.path == ("data", "containerData", "cpu")
    assert fault.report.code is FaultCode.INVALID
    assert fault.report.text.startswith("data.containerData.cpu: must be a number of cores")


def test_faults_of_one_request_have_all_their_paths() -> None:
    stream = ProtocolStream.for_engine()
    data = {"containerTag": "c", "containerData": {"cpu": "half", "memory": "much"}}
    (fault,) = stream.feed(json.dumps({"type": "CC", "data": data}), 0.0)
    assert isinstance(fault, Fault)
    paths = [one.path for one in fault.report.faults]
    assert paths == [("data", "containerData", "cpu"), ("data", "containerData", "memory")]


def test_fault_of_a_call_has_its_ids() -> None:
    stream = ProtocolStream.for_engine()
    data = {"iTag": "ask", "msgID": "call7", "type": "nonsense", "msg": {}}
    (fault,) = stream.feed(json.dumps({"type": "DM", "data": data}), 0.0)
    assert isinstance(fault, Fault)
    assert fault.report.call == CALL
    assert fault.report.text.startswith("ask, msgID call7: data.type: must be a class")
