"""Errors of the control channel.

::

    ControlError
    +-- MasterUnavailableError   the master did not answer in time
    +-- UnsendableError          a message is too long, or holds what no frame can hold
    +-- ContentError             a content cannot be fetched from the master
    +-- SnapshotError            a snapshot of a volume cannot be used, made or sent
    +-- NodeStateError            a snapshot of a node's state cannot be fetched, or is not kept
    +-- PeerGoneError            a task set left before it answered
    +-- PeerTimeoutError         a task set did not answer in time
    +-- PeerRefusedError         raised by the master's ``on_hello``: the task set is not taken
"""

from __future__ import annotations


class ControlError(Exception):
    """Base of all errors of the control channel. ``str()`` is fit to be shown to a user."""


class MasterUnavailableError(ControlError):
    """The master did not answer a request in time.

    Attributes:
        waited: How long was waited, in seconds.
    """

    def __init__(self, waited: float) -> None:
        super().__init__(waited)
        self.waited = waited

    def __str__(self) -> str:
        return f"the master did not answer within {self.waited:g} s; try again later"


class UnsendableError(ControlError):
    """A message is too long, or holds what no frame can hold.

    Attributes:
        problem: What is wrong with it.
    """

    def __init__(self, problem: str) -> None:
        super().__init__(problem)
        self.problem = problem

    def __str__(self) -> str:
        return f"the message cannot be sent: {self.problem}"


class ContentError(ControlError):
    """A content cannot be fetched from the master.

    Attributes:
        missing: Whether the master answered that it does not have it.
    """

    def __init__(self, problem: str, *, missing: bool = False) -> None:
        super().__init__(problem)
        self.missing = missing


class SnapshotError(ControlError):
    """A snapshot of a volume cannot be used, made or sent; the text says why.

    Attributes:
        is_temporary: Whether the master could not be reached, so that another attempt may help.
    """

    def __init__(self, problem: str, *, is_temporary: bool = False) -> None:
        super().__init__(problem)
        self.is_temporary = is_temporary


class NodeStateError(ControlError):
    """A snapshot of a node's state cannot be fetched from the master, or is not kept there."""


class PeerGoneError(ControlError):
    """A task set left before it answered.

    Attributes:
        process: Its name.
    """

    def __init__(self, process: str) -> None:
        super().__init__(process)
        self.process = process

    def __str__(self) -> str:
        return f"{self.process} left before it answered"


class PeerTimeoutError(ControlError):
    """A task set did not answer in time.

    Attributes:
        process: Its name.
        waited: How long was waited, in seconds.
    """

    def __init__(self, process: str, waited: float) -> None:
        super().__init__(process, waited)
        self.process = process
        self.waited = waited

    def __str__(self) -> str:
        return f"{self.process} did not answer within {self.waited:g} s"


class PeerRefusedError(ControlError):
    """The master does not take a task set.

    Attributes:
        reason: What the task set is told.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason
