"""Slow walks over JSON objects: which field is wrong, which fields are unknown."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

from rce.ros.types.values import NUMBERS
from rce_robot.converters.stamps import duration_from_json, time_from_json
from rce_robot.converters.values import BINARY, describe, to_octets
from rce_robot.exceptions import ConversionError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rce.ros.types import Field, MessageType
    from rce_robot.converters.custom import CustomConverter

MAX_PATH = 200
"""Longest path of an unknown field, in characters; its name is as long as the robot likes."""


def find_fault(kind: MessageType, value: Any, customs: Mapping[str, CustomConverter], path: str = "") -> None:
    """Walk a JSON object that could not be converted.

    Raises:
        ConversionError: For the first field whose value does not fit. Returns if all fit.
    """
    if not isinstance(value, dict):
        custom = customs.get(kind.name)
        if custom is None:
            raise ConversionError(
                path or kind.name, f"{describe(value)} is not an object of the fields of {kind.name}"
            )
        try:
            value = custom.decode(value)
        except ValueError as error:
            raise ConversionError(path or kind.name, str(error)) from error
    for field in kind.fields:
        if field.name in value:
            where = f"{path}.{field.name}" if path else field.name
            _check_field(field, value[field.name], customs, where)


def _check_field(field: Field, value: Any, customs: Mapping[str, CustomConverter], path: str) -> None:
    if not field.is_array:
        _check_element(field, value, customs, path)
    elif field.is_bytes and isinstance(value, (*BINARY, str)):
        _check_octets(field, value, path)
    elif not isinstance(value, (list, tuple)):
        raise ConversionError(path, f"{describe(value)} is not a {field.declared} (a list)")
    else:
        _check_length(field, len(value), path)
        for index, item in enumerate(value):
            _check_element(field, item, customs, f"{path}[{index}]")


def _check_octets(field: Field, value: Any, path: str) -> None:
    try:
        octets = to_octets(value)
    except ValueError:
        raise ConversionError(
            path, f"{describe(value)} is not a {field.declared} (a string must be base64)"
        ) from None
    _check_length(field, len(octets), path)


def _check_length(field: Field, length: int, path: str) -> None:
    if field.length is not None and length != field.length:
        raise ConversionError(path, f"has {length} elements, {field.declared} has {field.length}")


def _check_element(field: Field, value: Any, customs: Mapping[str, CustomConverter], path: str) -> None:
    if field.message is not None:
        find_fault(field.message, value, customs, path)
        return
    try:
        _check_scalar(field.type, value)
    except ValueError as error:
        raise ConversionError(path, str(error)) from error


def _check_scalar(type_name: str, value: Any) -> None:
    """Raise ValueError if a JSON value does not fit a built-in type."""
    if type_name == "time":
        time_from_json(value)
    elif type_name == "duration":
        duration_from_json(value)
    elif type_name == "string":
        if not isinstance(value, str):
            raise ValueError(f"{describe(value)} is not a string")
        value.encode()
    else:
        _check_number(type_name, value)


def _check_number(type_name: str, value: Any) -> None:
    number = NUMBERS[type_name]
    if type_name == "bool":
        fits = isinstance(value, bool)
    else:
        kinds = (int, float, type(None)) if number.is_float else (int, float)
        fits = isinstance(value, kinds) and not isinstance(value, bool)
        if isinstance(value, float) and not number.is_float:
            fits = value.is_integer()
            value = int(value) if fits else value
    if not fits:
        raise ValueError(f"{describe(value)} is not a {type_name}")
    if value is None:
        return
    try:
        struct.pack("<" + number.code, value)
    except (struct.error, OverflowError):
        raise ValueError(f"{describe(value)} is out of the range of {type_name}") from None


def unknown_fields(kind: MessageType, value: Any, path: str = "") -> Iterator[str]:
    """Yield the paths of fields that the type does not have; an array's elements have no index in them.

    Paths are cut to :data:`MAX_PATH` characters.
    """
    if not isinstance(value, dict):
        return
    fields = {field.name: field for field in kind.fields}
    for name, inner in value.items():
        where = f"{path}.{name}" if path else str(name)
        field = fields.get(name)
        if field is None:
            yield where if len(where) <= MAX_PATH else f"{where[:MAX_PATH]}..."
        elif field.message is not None:
            if field.is_array:
                for item in inner:
                    yield from unknown_fields(field.message, item, f"{where}[]")
            else:
                yield from unknown_fields(field.message, inner, where)
