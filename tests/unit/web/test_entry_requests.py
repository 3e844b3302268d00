"""Requests for the entry of a server: read and answered without an application."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.web.entry import (
    MAX_HEAD,
    EntryAnswer,
    EntryRequest,
    OtherRequestError,
    read_entry_request,
    write_entry_answer,
)

ASKS = b"GET /?userID=a&version=20130902 HTTP/1.1\r\nHost: h:9000\r\nAccept: */*\r\nUser-Agent: robot\r\n\r\n"


def test_request_of_a_robot() -> None:
    assert read_entry_request(ASKS) == EntryRequest("userID=a&version=20130902", closes=False)


@pytest.mark.parametrize(("word", "closes"), [(b"close", True), (b"Close", True), (b"keep-alive", False)])
def test_the_client_chooses_whether_to_close(word: bytes, closes: bool) -> None:
    data = ASKS.replace(b"\r\n\r\n", b"\r\nConnection: " + word + b"\r\n\r\n")
    assert read_entry_request(data) == EntryRequest("userID=a&version=20130902", closes=closes)


@pytest.mark.parametrize("end", range(len(ASKS)))
def test_a_part_of_a_request_is_waited_for(end: int) -> None:
    assert read_entry_request(ASKS[:end]) is None


@pytest.mark.parametrize(
    "data",
    [
        b"POST",
        b"GET /api",
        b"GET /? HTTP/1.0\r\nHost: h\r\n\r\n",
        b"GET /? HTTP/1.1\r\n\r\n",
        b"GET /? HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET /?a#b HTTP/1.1\r\nHost: h\r\n\r\n",
        b"GET /?a b HTTP/1.1\r\nHost: h\r\n\r\n",
        b"GET /?\xe4 HTTP/1.1\r\nHost: h\r\n\r\n",
        b"GET /? HTTP/1.1\r\nHost: h\r\nOrigin: http://h\r\n\r\n",
        b"GET /? HTTP/1.1\r\nHost: h\r\nContent-Length: 1\r\n\r\nx",
        b"GET /? HTTP/1.1\r\nHost: h\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"GET /? HTTP/1.1\r\nHost: h\r\nConnection: Upgrade\r\n\r\n",
        b"GET /? HTTP/1.1\r\nHost: h\r\nfolded:\r\n line\r\n\r\n",
        b"GET /? HTTP/1.1\r\nHost : h\r\n\r\n",
        b"GET /? HTTP/1.1\nHost: h\n\n" + b"x" * MAX_HEAD,
        ASKS + ASKS,
        b"GET /?" + b"a" * MAX_HEAD,
    ],
)
def test_other_requests_belong_to_the_application(data: bytes) -> None:
    with pytest.raises(OtherRequestError):
        read_entry_request(data)


@given(st.binary(max_size=200))
def test_no_bytes_cause_another_error(data: bytes) -> None:
    for begun in (b"", b"GET /?", ASKS[:-2]):
        with contextlib.suppress(OtherRequestError):
            read_entry_request(begun + data)


def test_answer_as_it_is_sent() -> None:
    answer = EntryAnswer(503, b"later\n", "text/plain", {"Retry-After": "1"})
    assert write_entry_answer(answer, closes=True) == (
        b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain\r\nContent-Length: 6\r\n"
        b"Retry-After: 1\r\nConnection: close\r\n\r\nlater\n"
    )
