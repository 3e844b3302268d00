"""XML-RPC documents: round trips, interoperability with the standard library, hostile input."""

from __future__ import annotations

import base64
import xmlrpc.client
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.ros.errors import MalformedDocumentError, RemoteFaultError
from rce.ros.xmlrpc import BadArgumentError, Dispatcher
from rce.ros.xmlrpc.codec import decode_call, decode_response, encode_call, encode_fault, encode_response

TEXT = st.text(
    st.characters(blacklist_categories=("Cs", "Cc"), blacklist_characters="\ufffe\uffff")
    | st.sampled_from("\n\r\t<&>")
)
VALUE = st.recursive(
    st.booleans()
    | st.integers(-(2**31), 2**31 - 1)
    | st.floats(allow_nan=False)
    | TEXT
    | st.binary(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=20,
)


@given(VALUE)
def test_values_survive(value: object) -> None:
    assert decode_response(encode_response(value)) == value
    assert decode_call(encode_call("method", (value, 1))) == ("method", (value, 1))


@given(VALUE)
def test_reads_what_the_standard_library_writes(value: Any) -> None:
    document = xmlrpc.client.dumps((value,), "m").replace("\r", "&#13;").encode()
    assert decode_call(document) == ("m", (value,))


@given(st.binary(max_size=200))
def test_garbage_is_refused_not_crashed_on(document: bytes) -> None:
    with pytest.raises(MalformedDocumentError):
        decode_response(document)


@pytest.mark.parametrize("number", ["1", "1e99999999", "NaN", "sNaN"])
def test_decimals_are_refused(number: str) -> None:
    """One of a few bytes would keep the reader busy for minutes when it is made an integer."""
    value = f"<params><param><value><bigdecimal>{number}</bigdecimal></value></param></params>"
    with pytest.raises(MalformedDocumentError, match="decimals are not accepted"):
        decode_response(f"<methodResponse>{value}</methodResponse>".encode())
    with pytest.raises(MalformedDocumentError, match="decimals are not accepted"):
        decode_call(f"<methodCall><methodName>m</methodName>{value}</methodCall>".encode())


@pytest.mark.parametrize("value", [None, 2**31, object(), "bell \x07", {1: 2}])
def test_refuses_to_write_what_has_no_form(value: object) -> None:
    with pytest.raises(MalformedDocumentError):
        encode_response(value)


def test_faults_arrive() -> None:
    with pytest.raises(RemoteFaultError, match="fault 7: no \\?"):
        decode_response(encode_fault(7, "no \x00"))


@pytest.mark.parametrize("value", ["<int>5</int>", "<struct></struct>", "<array><data></data></array>"])
def test_fault_without_code_and_text_is_malformed(value: str) -> None:
    with pytest.raises(MalformedDocumentError):
        decode_response(f"<methodResponse><fault><value>{value}</value></fault></methodResponse>".encode())


def test_empty_fault_is_malformed() -> None:
    with pytest.raises(MalformedDocumentError):
        decode_response(b"<methodResponse><fault></fault></methodResponse>")


def test_entities_are_not_expanded() -> None:
    bomb = b"""<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>
    <methodCall><methodName>m</methodName><params><param><value>&b;</value></param></params></methodCall>"""
    with pytest.raises(MalformedDocumentError, match="document types"):
        decode_call(bomb)


def test_deep_nesting_is_refused() -> None:
    deep = "<array><data><value>" * 1000
    with pytest.raises(MalformedDocumentError, match="nested"):
        decode_response(f"<methodResponse><params><param><value>{deep}".encode())


def test_a_value_without_type_is_a_string() -> None:
    document = b"<methodResponse><params><param><value>plain</value></param></params></methodResponse>"
    assert decode_response(document) == "plain"


def test_binary_is_base64() -> None:
    assert base64.b64encode(b"\x00\xff") in encode_response(b"\x00\xff")


class TestDispatcher:
    @staticmethod
    def ask(method: str, *arguments: object) -> Any:
        def add(caller: str, a: Any, b: Any = 1) -> Any:
            if not isinstance(a, int):
                raise BadArgumentError("a must be a number")
            return 1, caller, a // b

        return decode_response(Dispatcher({"add": add}).respond(encode_call(method, arguments)))

    def test_calls(self) -> None:
        assert self.ask("add", "/me", 6, 3) == [1, "/me", 2]
        assert self.ask("add", "/me", 6) == [1, "/me", 6]

    @pytest.mark.parametrize("arguments", [(), ("/me",), ("/me", 1, 2, 3), (5, 1), ("/me", "x")])
    def test_mistakes_of_the_caller_are_answered(self, arguments: tuple[Any, ...]) -> None:
        status, text, value = self.ask("add", *arguments)
        assert (status, value) == (-1, 0)
        assert text

    def test_failures_are_answered(self) -> None:
        assert self.ask("add", "/me", 1, 0)[0] == 0

    def test_unknown_methods_are_faults(self) -> None:
        with pytest.raises(RemoteFaultError):
            self.ask("subtract", "/me")

    def test_lists_methods(self) -> None:
        assert "add" in self.ask("system.listMethods")

    def test_many_calls_in_one(self) -> None:
        calls = [
            {"methodName": "add", "params": ["/me", 1]},
            {"methodName": "nothing", "params": ["/me"]},
            {"methodName": "system.multicall", "params": [[]]},
        ]
        good, unknown, nested = self.ask("system.multicall", calls)
        assert good == [[1, "/me", 1]]
        assert "faultCode" in unknown
        assert "faultCode" in nested
