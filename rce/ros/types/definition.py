"""Definition texts of ROS 1: ``.msg`` and ``.srv`` files read into fields and constants.

Source of the grammar and of the md5 sums: ROS's genmsg. Names of message types come out absolute
(``package/Type``); the checksum is made of the text without comments, which keeps the order of the fields.
"""

from __future__ import annotations

import hashlib
import io
import re
from typing import TYPE_CHECKING, NamedTuple

from rce.ros.types.exceptions import BadDefinitionError
from rce.ros.types.values import BUILTINS, NUMBERS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

SEPARATOR = "=" * 80
"""Line between the parts of a full definition text."""

PART_HEADER = "MSG: "
"""The text between the separator and the name of the part's type."""

MAX_FIXED_LENGTH = 1 << 20
"""Longest fixed array that a definition may ask for: its default value is made in memory."""

_TYPE = re.compile(r"([A-Za-z][A-Za-z0-9_]*(?:/[A-Za-z][A-Za-z0-9_]*)?)(\[(\d*)\])?")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")

ConstantValue = bool | int | float | str


class RawField(NamedTuple):
    """A field as the text declares it."""

    name: str
    type: str
    """A built-in type or the absolute name of a message type; without brackets."""
    is_array: bool
    length: int | None
    """Number of elements of a fixed array; None for the others."""
    line: int
    """Where it stands."""


class Constant(NamedTuple):
    """A constant of a message type."""

    name: str
    type: str
    value: ConstantValue
    text: str
    """The value as written, which the checksum is made of."""


class Definition(NamedTuple):
    """One message type's text, read."""

    name: str
    text: str
    fields: tuple[RawField, ...]
    constants: tuple[Constant, ...]
    source: str
    """The file, or the name where the text came from elsewhere."""


def parse_message(name: str, text: str, source: str = "", first_line: int = 1) -> Definition:
    """Read the text of a message type.

    Args:
        name: Absolute name of the type.
        text: Its definition without the parts of other types.
        source: Where the text is from, for errors.
        first_line: Line number of the text's first line in ``source``.

    Raises:
        BadDefinitionError: The text cannot be read.
    """
    source = source or name
    fields: list[RawField] = []
    constants: list[Constant] = []
    package = name.partition("/")[0]
    for number, line in enumerate(_lines(text), first_line):
        code = line.partition("#")[0].strip()
        if not code:
            continue
        try:
            if "=" in code:
                constants.append(_parse_constant(code, line))
            else:
                fields.append(_parse_field(code, package, number))
        except ValueError as error:
            raise BadDefinitionError(source, number, str(error)) from error
        _refuse_twice(fields, constants, source, number)
    return Definition(name, text, tuple(fields), tuple(constants), source)


def parse_service(name: str, text: str, source: str = "") -> tuple[Definition, Definition]:
    """Read the text of a service type into its request and its response.

    Raises:
        BadDefinitionError: The text cannot be read, or has not exactly one ``---`` line.
    """
    parts: list[list[str]] = [[]]
    for line in _lines(text):
        if line.strip() == "---":
            parts.append([])
        else:
            parts[-1].append(line)
    if len(parts) != 2:  # noqa: PLR2004
        raise BadDefinitionError(
            source or name, 0, f"a service has one '---' line, this text has {len(parts) - 1}"
        )
    request, response = ("".join(part) for part in parts)
    return (
        parse_message(f"{name}Request", request, source or name),
        parse_message(f"{name}Response", response, source or name, len(parts[0]) + 2),
    )


def split_full_text(name: str, text: str) -> Iterator[tuple[str, str]]:
    """Split a full definition text into ``(type name, text)``, the named type first.

    Raises:
        BadDefinitionError: A part does not begin with ``MSG: package/Type``.
    """
    first, *rest = re.split(rf"^{SEPARATOR}=*[ \t]*\r?\n", text, flags=re.MULTILINE)
    # ROS puts a line end after every part but the last.
    yield name, first.removesuffix("\n") if rest else first
    for index, part in enumerate(rest, 1):
        head, _, body = part.partition("\n")
        if not head.startswith(PART_HEADER):
            raise BadDefinitionError(
                name, 0, f"a part of the definition begins with {head[:80]!r}, not with 'MSG: '"
            )
        yield head.removeprefix(PART_HEADER).strip(), body.removesuffix("\n") if index < len(rest) else body


def checksum_text(definition: Definition, md5_of: Callable[[str], str]) -> str:
    """Return the text that ROS's checksum of a type is made of.

    Args:
        definition: The type.
        md5_of: Gives the checksum of another message type.
    """
    lines = [f"{constant.type} {constant.name}={constant.text}" for constant in definition.constants]
    for field in definition.fields:
        if field.type in BUILTINS:
            brackets = f"[{'' if field.length is None else field.length}]" if field.is_array else ""
            lines.append(f"{field.type}{brackets} {field.name}")
        else:
            lines.append(f"{md5_of(field.type)} {field.name}")
    return "\n".join(lines)


def md5(*texts: str) -> str:
    """Return the checksum of the texts, one after another, as hex digits."""
    return hashlib.md5("".join(texts).encode(), usedforsecurity=False).hexdigest()


def _lines(text: str) -> io.StringIO:
    """Return a text's lines with their ends: those of files, not the others of Unicode, as a form feed."""
    return io.StringIO(text, newline="")


def _parse_field(code: str, package: str, line: int) -> RawField:
    words = code.split()
    if len(words) != 2:  # noqa: PLR2004
        raise ValueError(f"{code!r} is neither 'type name' nor 'type NAME=value'")
    declared, name = words
    found = _TYPE.fullmatch(declared)
    if found is None:
        raise ValueError(f"{declared!r} is not a type")
    if _NAME.fullmatch(name) is None:
        raise ValueError(f"{name!r} is not a field name")
    base, brackets, digits = found.groups()
    length = int(digits) if digits else None
    if length is not None and length > MAX_FIXED_LENGTH:
        raise ValueError(f"{declared} is longer than {MAX_FIXED_LENGTH} elements")
    return RawField(name, _absolute(base, package), brackets is not None, length, line)


def _absolute(name: str, package: str) -> str:
    if name in BUILTINS or "/" in name:
        return name
    return "std_msgs/Header" if name == "Header" else f"{package}/{name}"


def _parse_constant(code: str, line: str) -> Constant:
    type_name, _, rest = code.partition(" ")
    name, _, text = rest.partition("=")
    if type_name == "string":
        # Everything after the first '=' belongs to a string, a '#' too.
        text = line.partition("=")[2]
    name, text = name.strip(), text.strip()
    if _NAME.fullmatch(name) is None:
        raise ValueError(f"{name!r} is not a constant's name")
    return Constant(name, type_name, _constant_value(type_name, text), text)


def _constant_value(type_name: str, text: str) -> ConstantValue:
    if type_name == "string":
        return text
    number = NUMBERS.get(type_name)
    if number is None:
        raise ValueError(f"a constant cannot be of type {type_name}")
    if type_name == "bool":
        words = {"true": True, "1": True, "false": False, "0": False}
        if text.lower() not in words:
            raise ValueError(f"{text!r} is not a bool")
        return words[text.lower()]
    if number.is_float:
        return float(text)
    value = int(text, 0) if not re.fullmatch(r"[+-]?0\d+", text) else int(text)
    if not number.low <= value <= number.high:
        raise ValueError(f"{value} is out of the range of {type_name}")
    return value


def _refuse_twice(fields: list[RawField], constants: list[Constant], source: str, line: int) -> None:
    names = [field.name for field in fields] + [constant.name for constant in constants]
    for index, name in enumerate(names):
        if name in names[:index]:
            raise BadDefinitionError(source, line, f"{name!r} is declared twice")
