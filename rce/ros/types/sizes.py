"""How long messages are on the wire, without writing them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce.ros.types.codegen import FAULTS, Code
from rce.ros.types.fields import attribute, element_min_size

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.ros.types.message import MessageType
    from rce.ros.types.values import Message


def make_size(message_type: MessageType) -> Callable[[Message], int]:
    """Make the function that returns the bytes of a message on the wire.

    A character of a text counts as one byte. Of a message that cannot be written, it returns the bytes of the
    shortest one.
    """
    shortest, extra = message_type.min_size, _make_extra(message_type)

    def size(message: Message) -> int:
        if extra is None:
            return shortest
        try:
            return shortest + extra(message)
        except FAULTS:
            return shortest

    return size


def _make_extra(message_type: MessageType) -> Callable[[Message], int] | None:
    """Make the function of the bytes beyond those of the shortest message; None where all are as long."""
    code = Code()
    parts = _extra_parts(code, message_type, "m")
    if not parts:
        return None
    code.line(f"return {' + '.join(parts)}")
    extra: Callable[[Message], int] = code.compile("extra(m)", f"size of {message_type.name}")
    return extra


def _extra_parts(code: Code, message_type: MessageType, holder: str) -> list[str]:
    parts = []
    for field in message_type.fields:
        value = f"{holder}.{attribute(field.name)}"
        if not field.is_array:
            if field.message is not None:
                parts += _extra_parts(code, field.message, value)
            elif field.type == "string":
                parts.append(f"len({value})")
            continue
        if field.is_bytes and field.length is None:
            parts.append(f"{code.bind(_octets)}({value})")
        elif field.length is None:
            parts.append(f"{element_min_size(field)} * len({value})")
        if field.type == "string":
            parts.append(f"sum(map(len, {value}))")
        elif field.message is not None and (extra := _make_extra(field.message)) is not None:
            parts.append(f"sum(map({code.bind(extra)}, {value}))")
    return parts


def _octets(values: Any) -> int:
    """Return the number of octets in bytes, in another buffer of them, or in a sequence of integers."""
    if values.__class__ is bytes:
        return len(values)
    try:
        view = memoryview(values)
    except TypeError:
        return len(values)
    return view.nbytes if view.itemsize == 1 else len(view)
