"""Conversions between JSON values of single fields and packed values.

Floats: JSON cannot represent NaN and the infinities. They stay floats and become ``null`` when the message is
written as text; ``null`` is read as NaN.
"""

from __future__ import annotations

import base64
import math
import sys
from array import array
from collections.abc import Callable
from typing import Any

from rce.ros.types.arrays import pack_numbers, unpack_numbers
from rce.ros.types.codegen import RefusedValueError
from rce.ros.types.faults import short
from rce.ros.types.values import Number

BINARY = (bytes, bytearray, memoryview)
"""The types of a received binary value."""

_INTEGERS = frozenset({int})
_FLOATS = frozenset({int, float})
_BOOLS = frozenset({bool})


def to_float(value: Any) -> float:
    """Convert a value that is not a float to a float."""
    if value.__class__ is int:
        return float(value)
    if value is None:
        return math.nan
    raise RefusedValueError


def to_integer(value: Any) -> int:
    """Read a number that is not an integer already: ``3.0`` is 3, as languages without integers write it."""
    if value.__class__ is float and value.is_integer():
        return int(value)
    raise RefusedValueError


def to_octets(value: Any) -> bytes | bytearray | memoryview:
    """Read ``uint8[]`` or ``char[]``: a binary value, a base64 string, or a list of numbers."""
    if isinstance(value, BINARY):
        return value
    if value.__class__ is str:
        return base64.b64decode(value, validate=True)
    if isinstance(value, (list, tuple)):
        return bytes(_integers(value))
    raise RefusedValueError


def number_packer(number: Number) -> Callable[[Any], bytes]:
    """Return the function that turns a list of numbers of one type into its bytes on the wire."""
    if number.code == "?":
        return _pack_bools
    code = number.code

    def pack(values: Any) -> bytes:
        if not isinstance(values, (list, tuple)):
            raise RefusedValueError
        if not number.is_float:
            values = _integers(values)
        elif not _FLOATS.issuperset(map(type, values)):
            values = [value if value.__class__ is float else to_float(value) for value in values]
        return pack_numbers(code, array(code, values))

    return pack


def _integers(values: list[Any] | tuple[Any, ...]) -> Any:
    """Read numbers without fraction; return a list of only integers unchanged."""
    if _INTEGERS.issuperset(map(type, values)):
        return values
    return [value if value.__class__ is int else to_integer(value) for value in values]


def _pack_bools(values: Any) -> bytes:
    if not isinstance(values, (list, tuple)) or not _BOOLS.issuperset(map(type, values)):
        raise RefusedValueError
    return bytes(values)


def unpack_list(code: str, chunk: Any) -> list[Any]:
    """Read an array of numbers from its bytes on the wire into a list."""
    if sys.byteorder == "big" and code != "?":
        return list(unpack_numbers(code, chunk))
    values: list[Any] = memoryview(chunk).cast(code).tolist()  # type: ignore[call-overload]  # of any code
    return values


def describe(value: Any) -> str:
    """Return the JSON name of a value's type."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, BINARY):
        return "a binary value"
    return {dict: "an object", list: "a list", type(None): "null"}.get(type(value)) or short(value)
