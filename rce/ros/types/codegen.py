"""Generated codecs: straight-line Python for one message type, made once.

A codec reads or writes all fields of a fixed size that stand next to each other with one
:class:`struct.Struct`, nested messages included, and touches every byte of an array once. A *dialect* defines
the values on the Python side: message objects (:mod:`rce.ros.types.objects`) or JSON objects
(``rce_robot.converters``). Readers are made by :mod:`rce.ros.types.readers`, writers by
:mod:`rce.ros.types.writers`.

Generated code checks only what costs nothing. When it fails in any of :data:`FAULTS`, the caller walks the
value slowly to find the field to blame.
"""

from __future__ import annotations

import struct
from typing import Any


class RefusedValueError(ValueError):
    """A value does not fit. Raised by generated code; the caller then finds the field."""


FAULTS = (
    struct.error,
    ValueError,
    TypeError,
    AttributeError,
    LookupError,
    OverflowError,
)
"""Exceptions of generated code for a value or a buffer that does not fit the type."""


class Code:
    """Lines of a function that is being generated, and the objects they name."""

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
            source: The code's name in tracebacks.
        """
        text = "\n".join([f"def {signature}:", *self.lines, ""])
        exec(compile(text, f"<generated {source}>", "exec"), self.names)  # noqa: S102  # of our own making
        return self.names[signature.partition("(")[0]]


class IndentedCode(Code):
    """The same code, one level deeper."""

    def __init__(self, code: Code) -> None:
        super().__init__()
        self._outer = code

    def line(self, text: str) -> None:
        """Add a line."""
        self._outer.line("    " + text)

    def variable(self) -> str:
        """Return the name of a new local variable."""
        return self._outer.variable()

    def bind(self, value: object) -> str:
        """Return a name by which the code reaches ``value``."""
        return self._outer.bind(value)
