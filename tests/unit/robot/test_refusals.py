"""What a robot hears of the master's refusals."""

from __future__ import annotations

from rce.control.messages import ClientReply, RequestFault
from rce.model import FaultCode
from rce.protocol.messages import ErrorReport
from rce_robot.master_requests import reports_of


def test_a_refusal_has_its_code_and_the_keys_of_the_request() -> None:
    fault = RequestFault(code="conflict", ids={"container": "c", "node": "n"})
    (report,) = reports_of(ClientReply(request=1, errors=("CN: no",), faults=(fault,)))
    ids = {"containerTag": "c", "nodeTag": "n"}
    assert report == ErrorReport(problem="CN: no", code=FaultCode.CONFLICT, ids=ids)


def test_a_master_of_the_release_before_gives_texts_only() -> None:
    assert reports_of(ClientReply(request=1, errors=("CN: a", "CN: b"))) == (
        ErrorReport(problem="CN: a"),
        ErrorReport(problem="CN: b"),
    )


def test_codes_and_keys_of_a_later_release_are_left_out() -> None:
    fault = RequestFault(code="melted", ids={"rack": "7", "a": "x/y"})
    (report,) = reports_of(ClientReply(request=1, errors=("CX: no",), faults=(fault,)))
    assert report == ErrorReport(problem="CX: no", ids={"tagA": "x/y"})
