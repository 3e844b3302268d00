"""Generates functions that read messages from their bytes on the wire."""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

from rce.ros.types.codegen import Code
from rce.ros.types.fields import Buffer, Field, element_min_size
from rce.ros.types.values import NUMBERS, STAMPS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce.ros.types.message import MessageType

_log = logging.getLogger(__name__)

Reader: TypeAlias = Callable[[Buffer, int], tuple[Any, int]]
"""Reads a value at a position and returns it with the position after it."""

OnBadText: TypeAlias = Literal["strict", "replace"]
"""What happens to bytes of a string that are not UTF-8: ``UnicodeDecodeError``, or U+FFFD in their place."""

MAX_EMPTY_ELEMENTS = 1 << 16
"""Longest array of messages without content: its length is not bounded by the size of the buffer."""


class ReadDialect(Protocol):
    """How values that were read become Python values; every method returns an expression."""

    def number(self, code: Code, field: Field, value: str) -> str:
        """Make the value of a number that :mod:`struct` gave."""

    def stamp(self, code: Code, field: Field, secs: str, nsecs: str) -> str:
        """Make the value of a time or duration."""

    def octets(self, code: Code, chunk: str) -> str:
        """Make the value of ``uint8[]`` or ``char[]``; ``chunk`` is a slice of the buffer."""

    def numbers(self, code: Code, field: Field, chunk: str) -> str:
        """Make the value of an array of numbers; ``chunk`` is a slice of the buffer."""

    def message(self, code: Code, message_type: MessageType, values: Sequence[str]) -> str:
        """Make a message of the expressions of its fields."""


class LenientReader:
    """Reads messages with strings that are not UTF-8, as rospy does; made when the first one comes.

    A driver in C++ may publish text of its device in any encoding.

    Args:
        type_name: The messages' type, for the log.
        make: Makes the reader that replaces what cannot be read.
    """

    def __init__(self, type_name: str, make: Callable[[], Reader]) -> None:
        self._type_name = type_name
        self._make = make
        self._read: Reader | None = None
        self._was_logged = False

    def __call__(self, buffer: Buffer, position: int) -> tuple[Any, int]:
        """Read a message; the first one that is complete is logged."""
        if self._read is None:
            self._read = self._make()
        found = self._read(buffer, position)
        if found[1] == len(buffer) and not self._was_logged:
            self._was_logged = True
            _log.warning(
                "a string of a %s is not UTF-8: what cannot be read is replaced by U+FFFD; logged once",
                self._type_name,
            )
        return found


class ReaderBuilder:
    """Generates the reader of one message type.

    Args:
        dialect: Makes Python values.
        reader_of: Makes the readers of nested types.
        on_bad_text: What happens to strings that are not UTF-8.
    """

    def __init__(
        self,
        dialect: ReadDialect,
        reader_of: Callable[[MessageType], Reader],
        on_bad_text: OnBadText = "strict",
    ) -> None:
        self._dialect = dialect
        self._reader_of = reader_of
        self._on_bad_text = on_bad_text
        self._code = Code()
        self._pending: list[tuple[str, str]] = []

    def build(self, message_type: MessageType) -> Reader:
        """Return the reader of ``message_type``."""
        value = self._message(message_type)
        self._flush()
        self._code.line(f"return {value}, p")
        reader: Reader = self._code.compile("read(b, p)", f"reader of {message_type.name}")
        return reader

    def _message(self, message_type: MessageType) -> str:
        return self._dialect.message(
            self._code, message_type, [self._field(field) for field in message_type.fields]
        )

    def _field(self, field: Field) -> str:
        if field.is_array:
            return self._array(field)
        if field.message is not None:
            return self._message(field.message)
        if field.type == "string":
            return self._string()
        if field.type in STAMPS:
            secs, nsecs = (self._take(code) for code in STAMPS[field.type])
            return self._dialect.stamp(self._code, field, secs, nsecs)
        return self._dialect.number(self._code, field, self._take(NUMBERS[field.type].code))

    def _array(self, field: Field) -> str:
        code = self._code
        count = str(field.length) if field.length is not None else self._take("I")
        self._flush()
        value = code.variable()
        if field.message is not None:
            self._messages(field, field.message, count, value)
        elif field.type == "string":
            code.line(f"{value} = []")
            code.line(f"for _ in range({count}):")
            code.line(f"    n, = {code.bind(struct.Struct('<I').unpack_from)}(b, p)")
            code.line("    e = p + 4 + n")
            code.line(f"    {value}.append(str(b[p + 4:e], 'utf-8', {self._on_bad_text!r}))")
            code.line("    p = e")
        else:
            code.line(f"e = p + {count} * {element_min_size(field)}")
            code.line(f"{value} = {self._chunk(field)}")
            code.line("p = e")
        return value

    def _chunk(self, field: Field) -> str:
        if field.is_bytes:
            return self._dialect.octets(self._code, "b[p:e]")
        if field.type in STAMPS:
            unpack = self._code.bind(struct.Struct("<" + "".join(STAMPS[field.type])).iter_unpack)
            return f"[{self._dialect.stamp(self._code, field, 's', 'n')} for s, n in {unpack}(b[p:e])]"
        return self._dialect.numbers(self._code, field, "b[p:e]")

    def _messages(self, field: Field, message_type: MessageType, count: str, value: str) -> None:
        code = self._code
        if field.length is None:
            # Before the loop: reading arrays of numbers beyond the end of the buffer does not fail.
            size = message_type.min_size
            too_many = f"{count} * {size} > len(b) - p" if size else f"{count} > {MAX_EMPTY_ELEMENTS}"
            code.line(f"if {too_many}: raise Refused")
        code.line(f"{value} = []")
        code.line(f"for _ in range({count}):")
        code.line(f"    x, p = {code.bind(self._reader_of(message_type))}(b, p)")
        code.line(f"    {value}.append(x)")

    def _string(self) -> str:
        size = self._take("I")
        self._flush()
        value = self._code.variable()
        self._code.line(f"e = p + {size}")
        self._code.line(f"{value} = str(b[p:e], 'utf-8', {self._on_bad_text!r})")
        self._code.line("p = e")
        return value

    def _take(self, format_code: str) -> str:
        variable = self._code.variable()
        self._pending.append((format_code, variable))
        return variable

    def _flush(self) -> None:
        if not self._pending:
            return
        layout = struct.Struct("<" + "".join(code for code, _ in self._pending))
        targets = ", ".join(variable for _, variable in self._pending)
        self._code.line(f"{targets}, = {self._code.bind(layout.unpack_from)}(b, p)")
        self._code.line(f"p += {layout.size}")
        self._pending.clear()
