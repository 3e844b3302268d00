"""Generated codecs: straight-line Python for one message type, made once.

A codec reads or writes all fields of a fixed size that stand next to each other with one
:class:`struct.Struct`, nested messages included, and touches every byte of an array once. What the values look
like on the Python side is the business of a *dialect*: message objects (:mod:`rce.ros.types.objects`) or JSON
objects (``rce_robot.converters``).

Generated code checks only what costs nothing. When it fails in any of :data:`FAULTS`, the caller walks the value
slowly to find the field to blame.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Protocol

from rce.ros.types.message import element_min_size
from rce.ros.types.values import NUMBERS, STAMPS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rce.ros.types.message import Buffer, Field, MessageType

    Reader = Callable[[Buffer, int], tuple[Any, int]]
    """Reads a value at a position and returns it with the position after it."""

MAX_EMPTY_ELEMENTS = 1 << 16
"""Longest array of messages without content: its length is not bounded by the size of the buffer."""


class RefusedValueError(ValueError):
    """Raised by generated code: a value does not fit. The field is found afterwards."""


FAULTS = (
    struct.error,
    ValueError,
    TypeError,
    AttributeError,
    LookupError,
    OverflowError,
)
"""What generated code raises for a value or a buffer that does not fit the type."""


class Code:
    """Lines of a function in the making, and the objects they name."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.names: dict[str, Any] = {"Refused": RefusedValueError}
        self._count = 0
        self._indent = "    "

    def line(self, text: str) -> None:
        """Add a line at the present depth."""
        self.lines.append(self._indent + text)

    def variable(self) -> str:
        """Return the name of a new local variable."""
        self._count += 1
        return f"v{self._count}"

    def bind(self, value: object) -> str:
        """Return a name by which the code reaches ``value``."""
        self._count += 1
        self.names[f"k{self._count}"] = value
        return f"k{self._count}"

    def compile(self, signature: str, source: str) -> Any:
        """Compile the lines as the body of a function and return it.

        Args:
            signature: Such as ``f(a, b)``.
            source: What to call the code in a traceback.
        """
        text = "\n".join([f"def {signature}:", *self.lines, ""])
        exec(compile(text, f"<generated {source}>", "exec"), self.names)  # noqa: S102  # of our own making
        return self.names[signature.partition("(")[0]]


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

    def message(self, code: Code, kind: MessageType, values: Sequence[str]) -> str:
        """Make a message of the expressions of its fields."""


class ReaderBuilder:
    """Generates the reader of one message type."""

    def __init__(self, dialect: ReadDialect, reader_of: Callable[[MessageType], Reader]) -> None:
        self._dialect = dialect
        self._reader_of = reader_of
        self._code = Code()
        self._pending: list[tuple[str, str]] = []

    def build(self, kind: MessageType) -> Reader:
        """Return the reader of ``kind``."""
        value = self._message(kind)
        self._flush()
        self._code.line(f"return {value}, p")
        reader: Reader = self._code.compile("read(b, p)", f"reader of {kind.name}")
        return reader

    def _message(self, kind: MessageType) -> str:
        return self._dialect.message(self._code, kind, [self._field(field) for field in kind.fields])

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
            code.line(f"    {value}.append(str(b[p + 4:e], 'utf-8'))")
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

    def _messages(self, field: Field, kind: MessageType, count: str, value: str) -> None:
        code = self._code
        if kind.min_size == 0 and field.length is None:
            code.line(f"if {count} > {MAX_EMPTY_ELEMENTS}: raise Refused")
        code.line(f"{value} = []")
        code.line(f"for _ in range({count}):")
        code.line(f"    x, p = {code.bind(self._reader_of(kind))}(b, p)")
        code.line(f"    {value}.append(x)")

    def _string(self) -> str:
        size = self._take("I")
        self._flush()
        value = self._code.variable()
        self._code.line(f"e = p + {size}")
        self._code.line(f"{value} = str(b[p:e], 'utf-8')")
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


class WriteDialect(Protocol):
    """How Python values become what is packed. Methods may add lines to the code."""

    def open(self, code: Code, kind: MessageType, holder: str) -> None:
        """Begin a message whose fields are taken from the variable ``holder``."""

    def close(self, code: Code, kind: MessageType, holder: str) -> None:
        """End a message: all its fields have been taken."""

    def take(self, code: Code, field: Field, holder: str) -> str:
        """Return an expression, to be used once, of the field's value."""

    def number(self, code: Code, field: Field, value: str) -> tuple[str, str]:
        """Return a :mod:`struct` character and the expression to pack with it."""

    def stamp(self, code: Code, field: Field, value: str) -> tuple[str, str]:
        """Return the expressions of seconds and nanoseconds."""

    def octets(self, code: Code, value: str) -> str:
        """Return the expression of the bytes of ``uint8[]`` or ``char[]``."""

    def numbers(self, code: Code, field: Field, value: str) -> str:
        """Return the expression of the bytes of an array of numbers."""

    def sequence(self, code: Code, value: str) -> str:
        """Return the expression of a list, checked to be one."""


class WriterBuilder:
    """Generates the writer of one message type.

    The writer takes the message and a list, which the dialect may use to note what it saw on the way.
    """

    def __init__(self, dialect: WriteDialect, writer_of: Callable[[MessageType], Any]) -> None:
        self._dialect = dialect
        self._writer_of = writer_of
        self._code = Code()
        self._pending: list[tuple[str, str]] = []
        self._parts: list[str] = []

    def build(self, kind: MessageType) -> Any:
        """Return the writer of ``kind``: ``write(message, notes) -> bytes``."""
        self._message(kind, "m")
        self._flush()
        self._code.line(f"return {self._joined()}")
        return self._code.compile("write(m, notes)", f"writer of {kind.name}")

    def _joined(self) -> str:
        if len(self._parts) > 2:  # noqa: PLR2004  # two parts are added faster than joined
            return f"b''.join(({', '.join(self._parts)}))"
        return " + ".join(self._parts) or "b''"

    def _message(self, kind: MessageType, holder: str) -> None:
        self._dialect.open(self._code, kind, holder)
        for field in kind.fields:
            self._field(field, self._dialect.take(self._code, field, holder))
        self._dialect.close(self._code, kind, holder)

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
            self._block(field, self._local(self._dialect.octets(self._code, value)))
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
            secs, nsecs = self._dialect.stamp(_Indented(code), field, "x")
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


class _Indented(Code):
    """The same code, one level deeper."""

    def __init__(self, code: Code) -> None:
        super().__init__()
        self._outer = code

    def line(self, text: str) -> None:
        self._outer.line("    " + text)

    def variable(self) -> str:
        return self._outer.variable()

    def bind(self, value: object) -> str:
        return self._outer.bind(value)
