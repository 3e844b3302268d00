"""Arrays of numbers and octets, to their bytes on the wire and back."""

from __future__ import annotations

import struct
import sys
from array import array
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rce.ros.types.fields import Buffer

BOOL_BYTES = {False: 0, True: 1}
"""How a bool is written; 0, 1 and numpy's bools are equal to the keys."""

_SIGNED, _UNSIGNED, _FLOATS = frozenset("bhilq"), frozenset("BHILQ"), frozenset("fd")


def unpack_numbers(code: str, chunk: Buffer) -> array[Any]:
    """Read an array of numbers from its bytes on the wire."""
    values = array(code, bytes(chunk))
    if sys.byteorder == "big":
        values.byteswap()
    return values


def pack_numbers(code: str, values: Any) -> bytes:
    """Turn a sequence, an array or a numpy array of numbers into its bytes on the wire."""
    if not (values.__class__ is array and values.typecode == code):
        try:
            view = memoryview(values)
        except TypeError:
            values = array(code, list(values))
        else:
            fits = view.ndim == 1 and view.itemsize == struct.calcsize(code) and _same_kind(code, view.format)
            values = view if fits else array(code, list(values))
    if sys.byteorder == "big":
        values = array(code, values)
        values.byteswap()
    data: bytes = values.tobytes()
    return data


def _same_kind(code: str, other: str) -> bool:
    return any(code in kind and other in kind for kind in (_SIGNED, _UNSIGNED, _FLOATS))


def pack_bools(values: Any) -> bytes:
    """Turn a sequence of bools into its bytes on the wire."""
    return bytes([BOOL_BYTES[value] for value in values])


def pack_octets(values: Any) -> bytes:
    """Turn bytes, an object that holds bytes, or a sequence of integers from 0 to 255 into bytes."""
    if values.__class__ is bytes:
        data: bytes = values
        return data
    try:
        view = memoryview(values)
    except TypeError:
        return bytes(list(values))
    return view.tobytes() if view.itemsize == 1 else bytes(list(values))
