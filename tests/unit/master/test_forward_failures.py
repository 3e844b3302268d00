"""What a stand-by logs of requests that the leader does not answer."""

from __future__ import annotations

import logging

import pytest

from rce_master.http.forward import REPORT_S, Failures


def test_many_failures_are_a_few_lines(caplog: pytest.LogCaptureFixture) -> None:
    now = 100.0
    failures = Failures(lambda: now)
    with caplog.at_level(logging.INFO):
        for number in range(5):
            failures.note(f"request {number}")
        now += REPORT_S
        failures.note("request 5")
        now += REPORT_S
        failures.note("request 6")
    assert [record.message for record in caplog.records] == [
        "request 0",
        "request 5; so were 4 requests before",
        "request 6",
    ]
