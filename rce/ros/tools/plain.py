"""Messages as plain values, and as text for users and programs."""

from __future__ import annotations

import base64
import json
from array import array
from typing import Any

import yaml

from rce.ros.types import Duration, MessageType, Time
from rce.ros.types.fields import attribute
from rce.ros.types.values import Message

_LONG = 64
"""Elements of an array above which it is cut in text for users."""


def plain(message: Message, *, longest: int | None = None) -> dict[str, Any]:
    """Turn a message into dictionaries, lists, numbers and strings.

    Args:
        message: The message.
        longest: Cut arrays after so many elements; None for whole ones.

    Returns:
        The fields in the order of the definition. Times and durations are ``{secs, nsecs}``; ``uint8[]`` and
        ``char[]`` are lists of numbers if cut, else base64.
    """
    message_type: MessageType = message._type  # noqa: SLF001 - its documented class variable
    return {
        field.name: _plain(getattr(message, attribute(field.name)), longest) for field in message_type.fields
    }


def _plain(value: Any, longest: int | None) -> Any:
    match value:
        case Message():
            return plain(value, longest=longest)
        case Time() | Duration():
            return {"secs": value.secs, "nsecs": value.nsecs}
        case bytes() if longest is None:
            return base64.b64encode(value).decode()
        case bytes() | array() | list():
            shown = [_plain(item, longest) for item in value[:longest]]
            hidden = len(value) - len(shown)
            return [*shown, f"... {hidden} more"] if hidden else shown
        case _:
            return value


def as_yaml(message: Message, *, whole: bool = False, arrays: bool = True) -> str:
    """Write a message as a YAML document without its end.

    Args:
        message: The message.
        whole: Arrays of more than 64 elements are not cut.
        arrays: Without them if False.
    """
    values = plain(message, longest=(None if whole else _LONG) if arrays else 0)
    return yaml.safe_dump(values, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)


def as_json(message: Message) -> str:
    """Write a message as one line of JSON; NaN and infinities are null."""
    return json.dumps(_without_nan(plain(message)), ensure_ascii=False)


def _without_nan(value: Any) -> Any:
    match value:
        case float():
            return value if value == value and abs(value) != float("inf") else None  # noqa: PLR0124
        case dict():
            return {key: _without_nan(item) for key, item in value.items()}
        case list():
            return [_without_nan(item) for item in value]
        case _:
            return value


def read_value(text: str) -> Any:
    """Read a value as YAML, as ROS's own tools do.

    Raises:
        ValueError: It is not YAML; the text says where.
    """
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"not a YAML value: {' '.join(str(error).split())}") from error


def read_fields(text: str, message_type: MessageType) -> dict[str, Any]:
    """Read the fields of a message as YAML: a mapping, a list in order, or the only field's value.

    Args:
        text: Such as ``{data: hello}``, ``[1, 2]`` or ``hello``; empty for all defaults.
        message_type: The message's type.

    Raises:
        ValueError: The value does not fit the type; the text says what was expected.
    """
    value = read_value(text)
    names = [field.name for field in message_type.fields]
    if value is None:
        return {}
    if isinstance(value, dict):
        return {str(name): item for name, item in value.items()}
    values = (
        value
        if isinstance(value, list) and not (len(names) == 1 and message_type.fields[0].is_array)
        else [value]
    )
    if len(values) != len(names):
        raise ValueError(
            f"{message_type.name} has {len(names)} fields ({', '.join(names) or 'none'}), "
            f"but {len(values)} values came; "
            "write a mapping such as {" + ", ".join(f"{name}: VALUE" for name in names[:2]) + "}"
        )
    return dict(zip(names, values, strict=True))
