"""What can go wrong in the demo.

::

    DemoError
    +-- PortTakenError      a port that the demo needs is in use
    +-- ChildDiedError      a program of the demo ended before it should
    +-- NotReadyError       something did not come up in time
    +-- NetworkError        the machines of the mode multi cannot be made
    +-- StationError        the operator station does not do what was asked
        +-- StationAwayError    ... at this moment: it, or the planner, cannot be reached
        +-- WishRefusedError    ... and asking again does not help
"""

from __future__ import annotations

import signal
from collections.abc import Sequence


class DemoError(Exception):
    """Base of what the demo tells its user in place of a traceback."""


class PortTakenError(DemoError):
    """A port is in use.

    Attributes:
        port: The port.
        option: The option by which another one is chosen.
    """

    def __init__(self, port: int, option: str) -> None:
        super().__init__(port, option)
        self.port = port
        self.option = option

    def __str__(self) -> str:
        return f"port {self.port} is in use; choose another one with {self.option}"


class ChildDiedError(DemoError):
    """A program of the demo ended.

    Attributes:
        name: Which.
        code: Its exit code, negative for a signal.
        tail: The last lines it printed.
    """

    def __init__(self, name: str, code: int, tail: Sequence[str]) -> None:
        super().__init__(name, code, tail)
        self.name = name
        self.code = code
        self.tail = tuple(tail)

    def __str__(self) -> str:
        said = "".join(f"\n    {line}" for line in self.tail) or " and printed nothing"
        return f"{self.name} {end_of(self.code)}{said}"


def end_of(code: int) -> str:
    """Say in words how a program ended.

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
    """Something did not come up in time."""


class NetworkError(DemoError):
    """The machines of the mode ``multi`` cannot be made."""


class StationError(DemoError):
    """The operator station does not do what was asked."""


class StationAwayError(StationError):
    """The station, or the planner behind it, cannot be reached at this moment."""


class WishRefusedError(StationError):
    """The station refuses, with a reason."""
