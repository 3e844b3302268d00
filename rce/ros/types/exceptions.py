"""Errors of message types.

::

    TypesError
    +-- UnknownTypeError    no definition of that name was found
    +-- BadDefinitionError  a definition's text is wrong (where: file and line)
    +-- SerializationError  a value does not fit its type, or bytes do not hold a message of it
"""

from __future__ import annotations


class TypesError(Exception):
    """Base of all errors of :mod:`rce.ros.types`."""


class UnknownTypeError(TypesError, LookupError):
    """The definition of a type was not found.

    Attributes:
        name: The requested type.
        hint: The places that were searched, and what was missing.
    """

    def __init__(self, name: str, hint: str) -> None:
        super().__init__(name, hint)
        self.name = name
        self.hint = hint

    def __str__(self) -> str:
        return f"unknown type {self.name}: {self.hint}"


class BadDefinitionError(TypesError, ValueError):
    """The text of a definition cannot be read.

    Attributes:
        source: The file, or the type's name where the text came from elsewhere.
        line: Line number in ``source``, from 1; 0 where the fault is of the whole.
        reason: The fault.
    """

    def __init__(self, source: str, line: int, reason: str) -> None:
        super().__init__(source, line, reason)
        self.source = source
        self.line = line
        self.reason = reason

    def __str__(self) -> str:
        where = f"{self.source}:{self.line}" if self.line else self.source
        return f"{where}: {self.reason}"


class SerializationError(TypesError, ValueError):
    """A value does not fit its type, or a buffer does not hold a message of that type.

    Attributes:
        type_name: The type of the whole message.
        field: Path of the faulty field, such as ``header.seq`` or ``poses[2].position.x``; empty for the
        whole. reason: What is wrong with it.
    """

    def __init__(self, type_name: str, field: str, reason: str) -> None:
        super().__init__(type_name, field, reason)
        self.type_name = type_name
        self.field = field
        self.reason = reason

    def __str__(self) -> str:
        return f"{self.field or self.type_name}: {self.reason}"
