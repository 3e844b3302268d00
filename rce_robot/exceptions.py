"""The errors between a robot and its endpoint.

::

    RobotError
    +-- UnreadableError        a data message is not what its interface carries
    |   +-- ConversionError    a JSON value does not fit the message type, or bytes are not a message of it
    +-- MisdirectedError       a data message is for no interface, or for one that takes none
    +-- BusyError              too much waits already
    +-- ConversionFailedError  another process took too long or too much for a conversion, or too many wait
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce.protocol import CallId, call_at

if TYPE_CHECKING:
    from typing import Self


class RobotError(Exception):
    """Base of all faults of :mod:`rce_robot`; the text is suitable for an ``ER``.

    Attributes:
        call: The service call that ends with it, if any.
    """

    call: CallId | None = None

    @classmethod
    def at(cls, tag: str, msg_id: str, problem: str) -> Self:
        """Make the fault of a message at an interface, with or without a service call."""
        call = call_at(tag, msg_id)
        error = cls(problem if call is not None else f"{tag}: {problem}")
        error.call = call
        return error

    @property
    def problem(self) -> str:
        """The words without the call."""
        return super().__str__()

    def __str__(self) -> str:
        return self.problem if self.call is None else f"{self.call}: {self.problem}"


class UnreadableError(RobotError):
    """A data message does not fit its interface."""


class ConversionError(UnreadableError, ValueError):
    """A message cannot be converted; the text is suitable for an ``ER``.

    Attributes:
        field: Path of the faulty field, such as ``header.seq`` or ``poses[2].position.x``; the type's name
            where the fault is of the whole message.
        reason: What is wrong with it.
    """

    def __init__(self, field: str, reason: str) -> None:
        super().__init__(field, reason)
        self.field = field
        self.reason = reason

    @property
    def problem(self) -> str:
        """The words without the call."""
        return f"{self.field}: {self.reason}"


class MisdirectedError(RobotError):
    """A data message names an unknown interface, one of another class, or one that only sends."""


class BusyError(RobotError):
    """Too many messages or calls wait already."""


class ConversionFailedError(RobotError):
    """A conversion was abandoned; the text is suitable for an ``ER``."""
