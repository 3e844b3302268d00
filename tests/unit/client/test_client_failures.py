"""Which failures are worth another attempt."""

from __future__ import annotations

import ssl

import pytest
from websockets.datastructures import Headers
from websockets.exceptions import InvalidMessage, InvalidStatus
from websockets.http11 import Response

from rce_client.exceptions import CallError, RefusedError, UnavailableError
from rce_client.failures import judge, judge_status


def test_a_robot_id_in_use_is_worth_another_try() -> None:
    error = judge_status(409, "robot 'r' is connected already, from 192.0.2.1")
    assert isinstance(error, UnavailableError)
    assert str(error).startswith("the robotID is in use; waiting until it is free: robot 'r'")


@pytest.mark.parametrize("status", [429, 500, 503, 504])
def test_statuses_that_may_pass(status: int) -> None:
    error = judge_status(status, "later")
    assert isinstance(error, UnavailableError)
    assert str(error) == f"unavailable ({status}): later"


@pytest.mark.parametrize("status", [400, 401, 403, 404, 410, 501])
def test_statuses_that_stay(status: int) -> None:
    error = judge_status(status, "never")
    assert isinstance(error, RefusedError)
    assert (error.status, error.reason) == (status, "never")


@pytest.mark.parametrize(
    "raised",
    [
        ConnectionRefusedError("refused"),
        ConnectionResetError(),
        TimeoutError(),
        EOFError(),
        OSError(113, "no route"),
        InvalidMessage("did not receive a valid HTTP response"),
    ],
)
def test_failures_of_the_network_may_pass(raised: Exception) -> None:
    error = judge(raised)
    assert isinstance(error, UnavailableError)
    assert str(error)


def test_a_handshakes_answer_is_read() -> None:
    body = b"Robot r is already connected.\n"
    error = judge(InvalidStatus(Response(409, "Conflict", Headers(), body)))
    assert isinstance(error, UnavailableError)
    assert error.reason == "Robot r is already connected."
    assert isinstance(judge(InvalidStatus(Response(401, "Unauthorized", Headers(), b""))), RefusedError)


def test_what_will_not_pass() -> None:
    assert isinstance(judge(ValueError("bad URL")), RefusedError)
    assert isinstance(judge(ssl.SSLCertVerificationError("self-signed")), RefusedError)


def test_own_errors_are_left_alone() -> None:
    error = CallError("x")
    assert judge(error) is error
