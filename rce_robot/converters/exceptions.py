"""What can go wrong when messages are converted.

::

    ConversionError    a JSON value does not fit the message type, or bytes are not a message of it
"""

from __future__ import annotations

from rce_robot.exceptions import UnreadableError


class ConversionError(UnreadableError, ValueError):
    """A message cannot be converted; the text is fit for an ``ER``.

    Attributes:
        field: Path of the faulty field, such as ``header.seq`` or ``poses[2].position.x``; the type's name
        where
            the fault is of the whole message.
        reason: What is wrong with it.
    """

    def __init__(self, field: str, reason: str) -> None:
        super().__init__(field, reason)
        self.field = field
        self.reason = reason

    def __str__(self) -> str:
        return f"{self.field}: {self.reason}"
