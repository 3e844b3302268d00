"""Several XML-RPC calls in one request: read as the standard library reads them, answered as one by one."""

from __future__ import annotations

from typing import Any
from xmlrpc.server import SimpleXMLRPCDispatcher

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.ros.errors import MalformedDocumentError, RemoteFaultError
from rce.ros.xmlrpc import Dispatcher
from rce.ros.xmlrpc.batches import join_calls, split_answer
from rce.ros.xmlrpc.codec import decode_response, encode_call, encode_response

from .test_ros_xmlrpc_codec import VALUE

MARKUP = "<param>\n</param>\n<params>\n</methodName>\n"


def echo(caller: str, *values: Any) -> tuple[int, str, list[Any]]:
    return 1, caller, list(values)


@given(st.lists(st.lists(VALUE, max_size=3), min_size=1, max_size=4))
def test_batch_is_answered_as_its_calls_are(arguments: list[list[Any]]) -> None:
    """For our server, and for the standard library's."""
    documents = [encode_call("echo", (MARKUP, *values)) for values in arguments]
    ours = Dispatcher({"echo": lambda caller, values=0, more=0, last=0: echo(caller, values, more, last)})
    answer = ours.respond(join_calls(documents))
    assert split_answer(answer, len(documents)) == [decode_response(ours.respond(one)) for one in documents]

    theirs: Any = SimpleXMLRPCDispatcher(allow_none=False, encoding="utf-8", use_builtin_types=True)
    theirs.register_function(echo, "echo")
    theirs.register_multicall_functions()
    expected = [[1, MARKUP, values] for values in arguments]
    answered = theirs._marshaled_dispatch(join_calls(documents).decode())
    assert split_answer(str(answered, "utf-8").replace("\r", "&#13;").encode(), len(documents)) == expected


def test_fault_of_one_call_is_only_its_answer() -> None:
    dispatcher = Dispatcher({"get": lambda _caller: (1, "", 7)})
    documents = [encode_call(method, ("/a",)) for method in ("get", "nothing", "get")]
    first, second, third = split_answer(dispatcher.respond(join_calls(documents)), 3)
    assert first == third == [1, "", 7]
    assert isinstance(second, RemoteFaultError)
    assert "no method 'nothing'" in second.text


@pytest.mark.parametrize(
    "answer",
    [
        0,
        [],
        [[1], [2], [3]],
        "text",
        {"faultCode": 1},
        [[1], 5],
        [[1], []],
        [[1], [1, 2]],
        [[1], {}],
        [0, "text"],
    ],
)
def test_answer_that_does_not_fit_the_calls_is_malformed(answer: object) -> None:
    """Such as the failure of all of them, ``[0, text, 0]``, which has a length too."""
    with pytest.raises(MalformedDocumentError):
        split_answer(encode_response(answer), 2)
