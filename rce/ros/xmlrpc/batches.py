"""Several calls in one request: ``system.multicall``, from encoded calls to the answer of each. Pure.

The calls are answered in their order, each as one value in a list, or as a fault. The standard library's
servers read and answer it in the same way (``xmlrpc.server.SimpleXMLRPCDispatcher``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rce.ros.errors import MalformedDocumentError, RemoteFaultError, XmlRpcError
from rce.ros.xmlrpc.codec import HEAD, decode_response

METHOD = "system.multicall"
"""Must not be called by one of several calls."""

MAX_CALLS = 64
"""Calls in one request: enough to make the cost of the request small beside theirs, and few enough that the
server's event loop is not held for long."""
MAX_BYTES = 2**18
"""Bytes of calls in one request, unless it holds only one."""

PRODUCT = b"rce"
"""The HTTP header ``Server`` of servers that take such requests. ROS's own servers know them too, but there
are others that do not, and a client must not find out by a call that fails."""

_NAME = b"<methodName>"
_NAME_END = b"</methodName>\n"
_PARAMS, _PARAMS_END = b"<params>\n", b"</params>\n</methodCall>\n"
_PARAM, _PARAM_END = b"<param>\n", b"</param>\n"

_FIRST = HEAD + (
    b"<methodCall>\n<methodName>%b</methodName>\n<params>\n<param>\n<value><array><data>\n" % METHOD.encode()
)
_LAST = b"</data></array></value>\n</param>\n</params>\n</methodCall>\n"


def join_calls(documents: Sequence[bytes]) -> bytes:
    """Write a request that makes several calls.

    Args:
        documents: The calls, by :func:`~rce.ros.xmlrpc.codec.encode_call`.
    """
    return b"".join((_FIRST, *map(_entry, documents), _LAST))


def split_answer(document: bytes, count: int) -> list[Any]:
    """Return the value or the error of each of ``count`` calls, in their order.

    Raises:
        RemoteFaultError: The server answered with a fault for all of them.
        MalformedDocumentError: The document does not hold that many answers, or one of no known form.
    """
    answers = decode_response(document)
    if not isinstance(answers, list) or len(answers) != count:
        raise MalformedDocumentError(f"this does not answer {count} calls")
    return [_value_or_error(answer) for answer in answers]


def _entry(document: bytes) -> bytes:
    """Write a call as a member of a list.

    Markup is escaped in all texts of a document, so that its tags are those that its encoder wrote.
    """
    head, _, rest = document.partition(_NAME_END)
    method = head.rpartition(_NAME)[2]
    values = (
        rest.removeprefix(_PARAMS).removesuffix(_PARAMS_END).replace(_PARAM, b"").replace(_PARAM_END, b"")
    )
    return (
        b"<value><struct>\n<member>\n<name>methodName</name>\n<value><string>%b</string></value>\n</member>\n"
        b"<member>\n<name>params</name>\n<value><array><data>\n%b</data></array></value>\n</member>\n"
        b"</struct></value>\n"
    ) % (method, values)


def _value_or_error(answer: Any) -> Any:
    match answer:
        case [value]:
            return value
        case {"faultCode": int(code), "faultString": text}:
            return RemoteFaultError(code, str(text))
        case _:
            raise MalformedDocumentError(f"{answer!r} is neither a value in a list nor a fault")


def raise_error(answer: Any) -> Any:
    """Return a call's value.

    Raises:
        XmlRpcError: The answer is an error.
    """
    if isinstance(answer, XmlRpcError):
        raise answer
    return answer
