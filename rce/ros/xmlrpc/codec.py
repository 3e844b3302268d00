"""XML-RPC documents: Python values to XML and back, with limits against hostile peers. Pure.

The standard library's marshalling does the work; the parser around it refuses document types (and with them
entity expansion), deep nesting and values that cannot be sent back.
Wire format: http://xmlrpc.com/spec.md.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any
from xml.parsers import expat
from xmlrpc.client import Fault, Marshaller, Unmarshaller

from rce.ros.errors import MalformedDocumentError, RemoteFaultError

MAX_DEPTH = 200
"""How deep elements may be nested; each level of a list or dictionary costs four."""

_DECIMAL = "bigdecimal"
"""An extension that only Python's library reads. The short text 1e99999999 becomes an integer of 40 MB."""

HEAD = b"<?xml version='1.0'?>\n"
"""How every document begins."""
_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


def encode_call(method: str, arguments: Sequence[Any]) -> bytes:
    """Write a method call.

    Raises:
        MalformedDocumentError: An argument has no XML-RPC form.
    """
    return (
        HEAD
        + f"<methodCall>\n<methodName>{method}</methodName>\n{_params(arguments)}</methodCall>\n".encode()
    )


def encode_response(value: Any) -> bytes:
    """Write the answer to a call.

    Raises:
        MalformedDocumentError: ``value`` has no XML-RPC form.
    """
    return HEAD + f"<methodResponse>\n{_params((value,))}</methodResponse>\n".encode()


def encode_fault(code: int, text: str) -> bytes:
    """Write a fault; characters that XML does not have are replaced."""
    body = Marshaller("utf-8").dumps(Fault(code, _NOT_XML.sub("?", text)))
    return HEAD + f"<methodResponse>\n{body}</methodResponse>\n".encode()


def decode_call(document: bytes) -> tuple[str, tuple[Any, ...]]:
    """Read a method call: the method's name and its arguments.

    Raises:
        MalformedDocumentError: This is not a method call, or it breaks a limit.
    """
    target = _parse(document)
    method = target.getmethodname()
    if method is None:
        raise MalformedDocumentError("the document calls no method")
    return method, _close(target)


def decode_response(document: bytes) -> Any:
    """Read the answer to a call.

    Raises:
        RemoteFaultError: The server answered with a fault.
        MalformedDocumentError: This is not an answer, or it breaks a limit.
    """
    values = _close(_parse(document))
    if len(values) != 1:
        raise MalformedDocumentError(f"an answer holds one value, not {len(values)}")
    return values[0]


def _params(values: Sequence[Any]) -> str:
    try:
        text = Marshaller("utf-8").dumps(tuple(values))
    except (TypeError, OverflowError, RecursionError) as error:
        raise MalformedDocumentError(f"a value has no XML-RPC form: {error}") from error
    if _NOT_XML.search(text):
        raise MalformedDocumentError("a string holds a character that XML does not have")
    return text.replace("\r", "&#13;")  # a parser would read a bare one as a line feed


def _parse(document: bytes) -> Unmarshaller:
    target = Unmarshaller(use_builtin_types=True)
    target.xml("", None)  # expat gives it text, not bytes in some encoding
    parser = expat.ParserCreate()
    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH:
            raise MalformedDocumentError(f"elements are nested deeper than {MAX_DEPTH}")
        if tag == _DECIMAL:
            raise MalformedDocumentError("decimals are not accepted")
        target.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        target.end(tag)

    def refuse_doctype(*_: object) -> None:
        raise MalformedDocumentError("document types are not accepted")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = target.data
    parser.StartDoctypeDeclHandler = refuse_doctype
    parser.buffer_text = True
    try:
        parser.Parse(document, True)
    except MalformedDocumentError:
        raise
    except Exception as error:  # the unmarshaller may raise any exception for a wrong value
        raise MalformedDocumentError(f"not XML-RPC: {error}") from error
    return target


def _close(target: Unmarshaller) -> tuple[Any, ...]:
    try:
        return target.close()
    except Fault as fault:
        raise RemoteFaultError(fault.faultCode, str(fault.faultString)) from fault
    except Exception as error:  # among them those of a fault without code and text
        raise MalformedDocumentError(f"not XML-RPC: {error}") from error
