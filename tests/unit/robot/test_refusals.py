"""What a robot hears of the master's refusals."""

from __future__ import annotations

import pytest
from support.absent_masters import FailingChannel

from rce.control.exceptions import MasterUnavailableError, UnsendableError
from rce.control.messages import ClientReply, RequestFault
from rce.model import EndpointId, FaultCode
from rce.model.requests import DestroyContainer
from rce.protocol.messages import ErrorReport
from rce_robot.master_requests import ask_master, reports_of


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


@pytest.mark.parametrize("typed", [True, False])
async def test_a_request_without_an_answer_may_have_been_done(typed: bool) -> None:
    channel = FailingChannel(MasterUnavailableError(10.0))
    (report,) = await ask_master(channel, EndpointId("u", "r"), DestroyContainer(tag="c"), typed=typed)
    assert report.problem.startswith("DC: it is not known whether it was done: the master did not answer")
    assert report.code is FaultCode.BUSY, "the client repeats it"


async def test_a_request_that_cannot_be_sent_was_not_done() -> None:
    channel = FailingChannel(UnsendableError("too long"))
    (report,) = await ask_master(channel, EndpointId("u", "r"), DestroyContainer(tag="c"), typed=True)
    assert report.problem == "DC: not done: the message cannot be sent: too long"
    assert report.code is None
