"""Slow walks that find the faulty field after a codec failed."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

from rce.ros.types.arrays import BOOL_BYTES
from rce.ros.types.codegen import FAULTS
from rce.ros.types.exceptions import SerializationError
from rce.ros.types.fields import Buffer, Field, attribute
from rce.ros.types.readers import MAX_EMPTY_ELEMENTS
from rce.ros.types.values import NUMBERS, STAMPS, Message

if TYPE_CHECKING:
    from rce.ros.types.message import MessageType

_LONG_INTEGER_BITS = 200
"""Python refuses to write very long integers as decimals."""

_LONGEST = 40
"""Characters of a value in an error's text."""


def find_fault(message_type: MessageType, message: Any, root: str, path: str = "") -> None:
    """Walk a message that could not be serialized.

    Raises:
        SerializationError: Of the first field whose value does not fit. Returns if there is none.
    """
    for field in message_type.fields:
        where = path + field.name
        try:
            value = getattr(message, attribute(field.name))
        except AttributeError:
            raise SerializationError(root, where, f"{short(message)} is not a {message_type.name}") from None
        if field.is_array:
            fault = array_fault(field, value, root, where)
            if fault.reason:
                raise fault
        else:
            _check_element(field, value, root, where)


def array_fault(field: Field, value: Any, root: str, path: str) -> SerializationError:
    """Return the fault of an array; its reason is empty if there is none."""
    try:
        items = list(value)
    except TypeError:
        return SerializationError(root, path, f"{short(value)} is not a {field.declared}")
    if isinstance(value, str):
        return SerializationError(root, path, f"{short(value)} is not a {field.declared}")
    if field.length is not None and len(items) != field.length:
        return SerializationError(
            root, path, f"has {len(items)} elements, {field.declared} has {field.length}"
        )
    for index, item in enumerate(items):
        try:
            _check_element(field, item, root, f"{path}[{index}]")
        except SerializationError as fault:
            return fault
    return SerializationError(root, path, "")


def _check_element(field: Field, value: Any, root: str, path: str) -> None:
    if field.message is not None:
        if not isinstance(value, Message):
            raise SerializationError(root, path, f"{short(value)} is not a {field.type}")
        find_fault(field.message, value, root, path + ".")
        return
    reason = scalar_fault(field.type, value)
    if reason:
        raise SerializationError(root, path, reason)


def scalar_fault(type_name: str, value: Any) -> str:
    """Return why ``value`` does not fit a built-in type; empty if it does."""
    try:
        if type_name == "string":
            value.encode()
        elif type_name in STAMPS:
            struct.pack("<" + "".join(STAMPS[type_name]), value.secs, value.nsecs)
        elif type_name == "bool":
            BOOL_BYTES[value]
        else:
            struct.pack("<" + NUMBERS[type_name].code, value)
    except UnicodeEncodeError as error:
        return f"cannot be written as UTF-8: {error.reason}"
    except FAULTS:
        number = NUMBERS.get(type_name)
        if (
            number is not None
            and isinstance(value, (int, float))
            and (number.is_float or isinstance(value, int))
        ):
            return f"{short(value)} is out of the range of {type_name}"
        return f"{short(value)} is not a {type_name}"
    return ""


def short(value: object) -> str:
    """Return a repr that fits a line and costs no more than that."""
    if isinstance(value, (str, bytes)):
        value = value[: _LONGEST + 1]
    elif isinstance(value, int) and value.bit_length() > _LONG_INTEGER_BITS:
        return f"an integer of {value.bit_length()} bits"
    elif not isinstance(value, (int, float)):
        return f"a {type(value).__name__}" if value is not None else "None"
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def read_fault(message_type: MessageType, buffer: Buffer) -> SerializationError:
    """Find out why ``buffer`` is not a message of ``message_type``."""
    try:
        end = _walk(message_type, memoryview(buffer).cast("B"), 0, message_type.name, "")
    except SerializationError as fault:
        return fault
    return SerializationError(
        message_type.name, "", f"{len(buffer) - end} bytes too many: {len(buffer)}, the message has {end}"
    )


def _walk(message_type: MessageType, buffer: memoryview, position: int, root: str, path: str) -> int:
    for field in message_type.fields:
        position = _walk_field(field, buffer, position, root, path + field.name)
    return position


def _walk_field(field: Field, buffer: memoryview, position: int, root: str, path: str) -> int:
    if not field.is_array:
        return _walk_element(field, buffer, position, root, path)
    count = field.length
    if count is None:
        count, position = _length(buffer, position, root, path)
    if field.message is None and field.type != "string":
        size = 8 if field.type in STAMPS else NUMBERS[field.type].size
        return _skip(buffer, position, count * size, root, path)
    if field.message is not None and field.message.min_size == 0 and count > MAX_EMPTY_ELEMENTS:
        raise SerializationError(root, path, f"has {count} elements without content")
    for index in range(count):
        position = _walk_element(field, buffer, position, root, f"{path}[{index}]")
    return position


def _walk_element(field: Field, buffer: memoryview, position: int, root: str, path: str) -> int:
    if field.message is not None:
        return _walk(field.message, buffer, position, root, path + ".")
    if field.type == "string":
        size, position = _length(buffer, position, root, path)
        return _skip(buffer, position, size, root, path)
    return _skip(buffer, position, 8 if field.type in STAMPS else NUMBERS[field.type].size, root, path)


def _length(buffer: memoryview, position: int, root: str, path: str) -> tuple[int, int]:
    end = _skip(buffer, position, 4, root, path)
    return int.from_bytes(buffer[position:end], "little"), end


def _skip(buffer: memoryview, position: int, size: int, root: str, path: str) -> int:
    end = position + size
    if end > len(buffer):
        raise SerializationError(
            root, path, f"the message ends after {len(buffer)} bytes, {end - len(buffer)} are missing"
        )
    return end
