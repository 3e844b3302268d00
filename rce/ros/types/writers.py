"""Generates functions that turn messages into their bytes on the wire."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Protocol

from rce.ros.types.codegen import Code, IndentedCode
from rce.ros.types.fields import Field, element_min_size
from rce.ros.types.values import NUMBERS, STAMPS

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.ros.types.message import MessageType


class WriteDialect(Protocol):
    """The conversion of Python values to packed ones. Methods may add lines to the code."""

    def open(self, code: Code, message_type: MessageType, holder: str) -> None:
        """Begin a message whose fields are taken from the variable ``holder``."""

    def close(self, code: Code, message_type: MessageType, holder: str) -> None:
        """End a message: all its fields have been taken."""

    def take(self, code: Code, field: Field, holder: str) -> str:
        """Return an expression, to be used once, of the field's value."""

    def number(self, code: Code, field: Field, value: str) -> tuple[str, str]:
        """Return a :mod:`struct` character and the expression to pack with it."""

    def stamp(self, code: Code, field: Field, value: str) -> tuple[str, str]:
        """Return the expressions of seconds and nanoseconds."""

    def octets(self, code: Code, value: str) -> str:
        """Return the expression of the octets of ``uint8[]`` or ``char[]``: any buffer of bytes."""

    def numbers(self, code: Code, field: Field, value: str) -> str:
        """Return the expression of the bytes of an array of numbers."""

    def sequence(self, code: Code, value: str) -> str:
        """Return the expression of a list, checked to be one."""


class WriterBuilder:
    """Generates the writer of one message type.

    The writer takes the message and a list, in which the dialect may note what it has to report.
    """

    def __init__(self, dialect: WriteDialect, writer_of: Callable[[MessageType], Any]) -> None:
        self._dialect = dialect
        self._writer_of = writer_of
        self._code = Code()
        self._pending: list[tuple[str, str]] = []
        self._parts: list[str] = []
        self._buffers: set[str] = set()
        """Parts that may be another buffer than bytes."""

    def build(self, message_type: MessageType) -> Any:
        """Return the writer of ``message_type``: ``write(message, notes) -> bytes``."""
        self._message(message_type, "m")
        self._flush()
        self._code.line(f"return {self._joined()}")
        return self._code.compile("write(m, notes)", f"writer of {message_type.name}")

    def _joined(self) -> str:
        parts = self._parts
        if len(parts) > 2 or (parts and parts[0] in self._buffers):  # noqa: PLR2004  # two are added faster
            return f"b''.join(({', '.join(parts)},))"
        return " + ".join(parts) or "b''"

    def _message(self, message_type: MessageType, holder: str) -> None:
        self._dialect.open(self._code, message_type, holder)
        for field in message_type.fields:
            self._field(field, self._dialect.take(self._code, field, holder))
        self._dialect.close(self._code, message_type, holder)

    def _field(self, field: Field, value: str) -> None:
        if field.is_array:
            self._array(field, value)
        elif field.message is not None:
            holder = self._local(value)
            self._message(field.message, holder)
        elif field.type == "string":
            data = self._local(f"{value}.encode()")
            self._pending.append(("I", f"len({data})"))
            self._part(data)
        elif field.type in STAMPS:
            values = self._dialect.stamp(self._code, field, value)
            self._pending += zip(STAMPS[field.type], values, strict=True)
        else:
            self._pending.append(self._dialect.number(self._code, field, value))

    def _array(self, field: Field, value: str) -> None:
        if field.is_bytes:
            data = self._local(self._dialect.octets(self._code, value))
            self._buffers.add(data)
            self._block(field, data)
        elif field.type in NUMBERS:
            self._block(field, self._local(self._dialect.numbers(self._code, field, value)))
        else:
            self._elements(field, self._local(self._dialect.sequence(self._code, value)))

    def _block(self, field: Field, data: str) -> None:
        size = element_min_size(field)
        if field.length is None:
            self._pending.append(("I", f"len({data})" if size == 1 else f"len({data}) // {size}"))
        else:
            self._code.line(f"if len({data}) != {field.length * size}: raise Refused")
        self._part(data)

    def _elements(self, field: Field, values: str) -> None:
        code = self._code
        if field.length is None:
            self._pending.append(("I", f"len({values})"))
        else:
            code.line(f"if len({values}) != {field.length}: raise Refused")
        if field.message is not None:
            self._part(f"b''.join([{code.bind(self._writer_of(field.message))}(x, notes) for x in {values}])")
            return
        data = code.variable()
        code.line(f"{data} = []")
        code.line(f"for x in {values}:")
        if field.type == "string":
            code.line("    x = x.encode()")
            code.line(f"    {data}.append({code.bind(struct.Struct('<I').pack)}(len(x)) + x)")
        else:
            pack = code.bind(struct.Struct("<" + "".join(STAMPS[field.type])).pack)
            secs, nsecs = self._dialect.stamp(IndentedCode(code), field, "x")
            code.line(f"    {data}.append({pack}({secs}, {nsecs}))")
        self._part(f"b''.join({data})")

    def _local(self, expression: str) -> str:
        variable = self._code.variable()
        self._code.line(f"{variable} = {expression}")
        return variable

    def _part(self, expression: str) -> None:
        self._flush()
        self._parts.append(expression)

    def _flush(self) -> None:
        if not self._pending:
            return
        pack = self._code.bind(struct.Struct("<" + "".join(code for code, _ in self._pending)).pack)
        self._parts.append(f"{pack}({', '.join(value for _, value in self._pending)})")
        self._pending.clear()
