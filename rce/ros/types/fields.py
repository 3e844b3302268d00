"""The fields of a message type and their properties. Pure descriptions: no values."""

from __future__ import annotations

import keyword
from typing import TYPE_CHECKING, NamedTuple

from rce.ros.types.values import BYTES_TYPES, NUMBERS, STAMPS

if TYPE_CHECKING:
    from rce.ros.types.message import MessageType

Buffer = bytes | bytearray | memoryview
"""The buffer of a serialized message."""

LARGE = 1 << 16
"""Bytes above which a message is read through a view: slicing it copies nothing."""


class Field(NamedTuple):
    """A field of a message type."""

    name: str
    type: str
    """A built-in type (``uint8``, ``string``, ``time`` ...) or a message type; without brackets."""
    is_array: bool
    length: int | None
    """Number of elements of a fixed array; None for a variable array or no array."""
    message: MessageType | None
    """The type of the field's message or messages; None for built-in types."""

    @property
    def declared(self) -> str:
        """The type as a definition writes it, such as ``float64[36]``."""
        if not self.is_array:
            return self.type
        return f"{self.type}[{'' if self.length is None else self.length}]"

    @property
    def is_bytes(self) -> bool:
        """Whether the value is held as ``bytes``."""
        return self.is_array and self.type in BYTES_TYPES


def attribute(name: str) -> str:
    """Return the attribute that holds a field: its name, with a ``_`` at the end of a Python keyword."""
    return f"{name}_" if keyword.iskeyword(name) else name


def repetitions(field: Field) -> int:
    """Return how many elements the shortest value has: 0 for a variable array, 1 without an array."""
    if not field.is_array:
        return 1
    return field.length or 0


def min_size(field: Field) -> int:
    """Return the bytes of the shortest value of a field on the wire."""
    if field.is_array and field.length is None:
        return 4
    return element_min_size(field) * (field.length if field.length is not None else 1)


def element_min_size(field: Field) -> int:
    """Return the bytes of the shortest value, or of the shortest element of an array."""
    if field.message is not None:
        return field.message.min_size
    if field.type in NUMBERS:
        return NUMBERS[field.type].size
    return 8 if field.type in STAMPS else 4
