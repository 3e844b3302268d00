"""Errors of the demo.

::

    DemoError
    +-- PortInUseError      a port that the demo needs is in use
    +-- ProgramEndedError   a program of the demo ended unexpectedly
    +-- NotReadyError       a program was not ready in time
    +-- NetworkError        the network of the mode multi cannot be created
"""

from __future__ import annotations

import signal
from collections.abc import Sequence

from rce_fleet.exceptions import FleetError


class DemoError(FleetError):
    """Base of the errors that the demo shows to its user without a traceback."""


class PortInUseError(DemoError):
    """A port is in use.

    Attributes:
        port: The port.
        option: The option that sets another port.
    """

    def __init__(self, port: int, option: str) -> None:
        super().__init__(port, option)
        self.port = port
        self.option = option

    def __str__(self) -> str:
        return f"port {self.port} is in use; choose another one with {self.option}"


class ProgramEndedError(DemoError):
    """A program of the demo ended.

    Attributes:
        name: Name of the program.
        code: Its exit code, negative for a signal.
        tail: The last lines that it printed.
    """

    def __init__(self, name: str, code: int, tail: Sequence[str]) -> None:
        super().__init__(name, code, tail)
        self.name = name
        self.code = code
        self.tail = tuple(tail)

    def __str__(self) -> str:
        printed = "".join(f"\n    {line}" for line in self.tail) or " and printed nothing"
        return f"{self.name} {describe_exit(self.code)}{printed}"


def describe_exit(code: int) -> str:
    """Return how a program ended, in words.

    Args:
        code: Its exit code, negative for a signal.
    """
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"was ended by signal {-code}"


class NotReadyError(DemoError):
    """A program was not ready in time."""


class NetworkError(DemoError):
    """The network of the mode ``multi`` cannot be created."""
