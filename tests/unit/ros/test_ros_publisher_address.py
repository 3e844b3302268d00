"""Answers to ``requestTopic``: an address, or one error whatever came."""

from __future__ import annotations

from typing import Any

import pytest

from rce.ros.errors import TcprosError
from rce.ros.tcpros.address import read_address


@pytest.mark.parametrize("port", [1, 65535, "11311"])
def test_address_is_read(port: Any) -> None:
    answer = [1, "ready", ["TCPROS", "robot", port]]
    assert read_address(answer, "http://a:1/", "/t") == ("robot", int(port))


@pytest.mark.parametrize("port", ["x", None, 0, -1, 70_000, float("inf"), float("nan"), [], {}])
def test_port_that_cannot_be_is_refused(port: Any) -> None:
    with pytest.raises(TcprosError, match="http://a:1/"):
        read_address([1, "", ["TCPROS", "127.0.0.1", port]], "http://a:1/", "/t")


@pytest.mark.parametrize("host", ["", None, 5, ["a"]])
def test_host_that_cannot_be_is_refused(host: Any) -> None:
    with pytest.raises(TcprosError, match="http://a:1/"):
        read_address([1, "", ["TCPROS", host, 80]], "http://a:1/", "/t")


@pytest.mark.parametrize(
    "answer", [None, 5, "abc", [], {}, [1, "", None], [1, "", []], [1, "", 5], [0, "no", 0], [-1, "no", []]]
)
def test_answer_of_another_form_is_refused(answer: Any) -> None:
    with pytest.raises(TcprosError, match=r"/t|known form"):
        read_address(answer, "http://a:1/", "/t")
