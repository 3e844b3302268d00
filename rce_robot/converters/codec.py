"""Generated codecs between JSON objects and bytes, with no message object in between."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rce.ros.types.codegen import Code
from rce.ros.types.readers import OnBadText, Reader, ReaderBuilder
from rce.ros.types.values import NUMBERS
from rce.ros.types.writers import WriterBuilder
from rce_robot.converters.stamps import (
    duration_from_json,
    duration_to_json,
    time_from_json,
    time_to_json,
)
from rce_robot.converters.values import number_packer, to_float, to_integer, to_octets, unpack_list

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rce.ros.types import Field, MessageType
    from rce_robot.converters.custom import CustomConverter

_MISSING: Any = object()
_NO_FIELDS: dict[str, Any] = {}


def make_reader(
    kind: MessageType, customs: Mapping[str, CustomConverter], on_bad_text: OnBadText = "strict"
) -> Reader:
    """Make the function that reads JSON objects of ``kind`` from their bytes on the wire."""

    def reader_of(needed: MessageType) -> Reader:
        return ReaderBuilder(_JsonReading(customs), reader_of, on_bad_text).build(needed)

    return reader_of(kind)


def make_writer(
    kind: MessageType, customs: Mapping[str, CustomConverter]
) -> Callable[[Any, list[bool]], bytes]:
    """Make the function that turns JSON objects of ``kind`` into their bytes on the wire.

    The function's second argument is a list: it is not empty afterwards if there were unknown fields.
    """

    def writer_of(needed: MessageType) -> Any:
        return WriterBuilder(_JsonWriting(customs), writer_of).build(needed)

    writer: Callable[[Any, list[bool]], bytes] = writer_of(kind)
    return writer


class _JsonReading:
    """Converts read values to JSON values."""

    def __init__(self, customs: Mapping[str, CustomConverter]) -> None:
        self._customs = customs

    def number(self, code: Code, field: Field, value: str) -> str:
        del code, field
        return value

    def stamp(self, code: Code, field: Field, secs: str, nsecs: str) -> str:
        write = code.bind(time_to_json if field.type == "time" else duration_to_json)
        return f"{write}({secs}, {nsecs})"

    def octets(self, code: Code, chunk: str) -> str:
        # A view, not a copy: large data is here.
        return f"{code.bind(memoryview)}(b){chunk.removeprefix('b')}"

    def numbers(self, code: Code, field: Field, chunk: str) -> str:
        return f"{code.bind(unpack_list)}({NUMBERS[field.type].code!r}, {chunk})"

    def message(self, code: Code, kind: MessageType, values: Sequence[str]) -> str:
        items = (f"{field.name!r}: {value}" for field, value in zip(kind.fields, values, strict=True))
        fields = f"{{{', '.join(items)}}}"
        custom = self._customs.get(kind.name)
        return fields if custom is None else f"{code.bind(custom.encode)}({fields})"


class _JsonWriting:
    """Takes values from JSON objects; missing fields get their defaults, unknown ones are noted."""

    def __init__(self, customs: Mapping[str, CustomConverter]) -> None:
        self._customs = customs

    def open(self, code: Code, kind: MessageType, holder: str) -> None:
        custom = self._customs.get(kind.name)
        act = "raise Refused" if custom is None else f"{holder} = {code.bind(custom.decode)}({holder})"
        code.line(f"if {holder}.__class__ is not dict: {act}")
        code.line(f"g_{holder} = {holder}.get")
        code.line(f"n_{holder} = {len(kind.fields)}")

    def close(self, code: Code, kind: MessageType, holder: str) -> None:
        del kind
        code.line(f"if len({holder}) != n_{holder}: notes.append(True)")

    def take(self, code: Code, field: Field, holder: str) -> str:
        value = code.variable()
        missing = code.bind(_MISSING)
        code.line(f"{value} = g_{holder}({field.name!r}, {missing})")
        code.line(f"if {value} is {missing}:")
        code.line(f"    {value} = {code.bind(_json_default(field))}")
        code.line(f"    n_{holder} -= 1")
        if not field.is_array and field.type in NUMBERS:
            _check_number(code, field, value)
        return value

    def number(self, code: Code, field: Field, value: str) -> tuple[str, str]:
        del code
        return NUMBERS[field.type].code, value

    def stamp(self, code: Code, field: Field, value: str) -> tuple[str, str]:
        secs, nsecs = code.variable(), code.variable()
        read = code.bind(time_from_json if field.type == "time" else duration_from_json)
        code.line(f"{secs}, {nsecs} = {read}({value})")
        return secs, nsecs

    def octets(self, code: Code, value: str) -> str:
        return f"{code.bind(to_octets)}({value})"

    def numbers(self, code: Code, field: Field, value: str) -> str:
        return f"{code.bind(number_packer(NUMBERS[field.type]))}({value})"

    def sequence(self, code: Code, value: str) -> str:
        code.line(f"if {value}.__class__ is not list and {value}.__class__ is not tuple: raise Refused")
        return value


def _check_number(code: Code, field: Field, value: str) -> None:
    """Add the checks of numbers, bools and strings; ranges are checked where the numbers are packed."""
    if field.type == "bool":
        code.line(f"elif {value} is not True and {value} is not False: raise Refused")
    elif NUMBERS[field.type].is_float:
        code.line(f"elif {value}.__class__ is not float: {value} = {code.bind(to_float)}({value})")
    else:
        code.line(f"elif {value}.__class__ is not int: {value} = {code.bind(to_integer)}({value})")


def _json_default(field: Field) -> Any:
    """Return the default of a field in JSON form; it is never changed."""
    if not field.is_array:
        return _element_default(field)
    length = field.length or 0
    return bytes(length) if field.is_bytes else (_element_default(field),) * length


def _element_default(field: Field) -> Any:
    if field.message is not None:
        return _NO_FIELDS
    if field.type in NUMBERS:
        return False if field.type == "bool" else 0.0 if NUMBERS[field.type].is_float else 0
    return {"string": "", "time": _NO_FIELDS, "duration": 0}[field.type]
