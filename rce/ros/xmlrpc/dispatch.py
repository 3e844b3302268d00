"""Answers method calls, from document to document, for ROS-style APIs. No I/O.

Every ROS method answers ``[status, message, value]`` with status 1 for success, 0 for a failure and -1 for a
mistake of the caller. Real clients do not expect faults, so a wrong number or kind of arguments is answered
``[-1, message, 0]`` (or another empty value, of the type of the method's answers). A fault means only that
the method does not exist or that the document is not a call.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rce.ros.errors import MalformedDocumentError
from rce.ros.xmlrpc.codec import decode_call, encode_fault, encode_response

_log = logging.getLogger(__name__)

Method = Callable[..., Any]
"""A method of an API; must not block.

It takes the caller's name first if it takes anything, and returns ``(status, message, value)``.
"""

ERROR, FAILURE, SUCCESS = -1, 0, 1
MAX_MULTICALL = 10_000
"""How many calls one ``system.multicall`` may hold."""

_FAULT_NO_METHOD = -32601
_FAULT_NO_CALL = -32600


class BadArgumentError(ValueError):
    """Raised by a method for a caller's mistake; answered ``[-1, message, nothing]``."""


class Dispatcher:
    """The methods of one server, with ``system.listMethods`` and ``system.multicall`` added."""

    def __init__(self, methods: Mapping[str, Method], nothing: Mapping[str, Any] | None = None) -> None:
        """Prepare the answers.

        Args:
            methods: By their names.
            nothing: The value in a method's failed answers; 0 for methods that are not listed.
        """
        self._methods = dict(methods)
        self._nothing = dict(nothing or {})
        self._arity = {name: _arity(method) for name, method in methods.items()}

    def respond(self, document: bytes) -> bytes:
        """Answer the call in ``document``. Never raises."""
        try:
            method, arguments = decode_call(document)
        except Exception as error:  # noqa: BLE001 - the sender gets every failure of the parser
            return encode_fault(_FAULT_NO_CALL, str(error))
        try:
            result = self._call(method, arguments)
        except _NoSuchMethodError as error:
            return encode_fault(_FAULT_NO_METHOD, str(error))
        try:
            return encode_response(result)
        except MalformedDocumentError as error:
            _log.warning("the answer to %s cannot be sent: %s", method, error)
            return encode_response((FAILURE, str(error), 0))

    def _call(self, method: str, arguments: Sequence[Any]) -> Any:
        if method == "system.listMethods":
            return sorted([*self._methods, "system.listMethods", "system.multicall"])
        if method == "system.multicall":
            return self._multicall(arguments)
        handler = self._methods.get(method)
        if handler is None:
            raise _NoSuchMethodError(f"there is no method {method!r}")
        try:
            self._check(method, arguments)
            return handler(*arguments)
        except BadArgumentError as error:
            return ERROR, f"{method}: {error}", self._nothing.get(method, 0)
        except Exception as error:  # noqa: BLE001 - the caller always gets an answer
            _log.exception("%s failed for %s", method, arguments[0] if arguments else "?")
            return FAILURE, f"internal failure: {error}", self._nothing.get(method, 0)

    def _check(self, method: str, arguments: Sequence[Any]) -> None:
        at_least, at_most = self._arity[method]
        if not at_least <= len(arguments) <= at_most:
            raise BadArgumentError(f"takes {at_least} arguments, not {len(arguments)}")
        if arguments and not isinstance(arguments[0], str):
            raise BadArgumentError("the caller's id must be a string")

    def _multicall(self, arguments: Sequence[Any]) -> list[Any]:
        if len(arguments) != 1 or not isinstance(arguments[0], list) or len(arguments[0]) > MAX_MULTICALL:
            raise _NoSuchMethodError(f"system.multicall takes one list of at most {MAX_MULTICALL} calls")
        return [self._one_of_many(call) for call in arguments[0]]

    def _one_of_many(self, call: Any) -> Any:
        try:
            method, parameters = call["methodName"], call["params"]
            if method == "system.multicall" or not isinstance(parameters, list):
                raise _NoSuchMethodError("a call within system.multicall needs a name and a list")  # noqa: TRY301
            return [self._call(method, parameters)]
        except (_NoSuchMethodError, KeyError, TypeError) as error:
            return {"faultCode": _FAULT_NO_METHOD, "faultString": str(error)}


class _NoSuchMethodError(Exception):
    """The method does not exist."""


def _arity(method: Method) -> tuple[int, int]:
    parameters = inspect.signature(method).parameters.values()
    required = sum(parameter.default is parameter.empty for parameter in parameters)
    return required, len(parameters)
