"""What can go wrong between a robot and its endpoint.

::

    RobotError
    +-- UnreadableError    a data message is not what its interface carries
    +-- MisdirectedError   a data message is for no interface, or for one that takes none
    +-- BusyError          too much waits already
"""

from __future__ import annotations


class RobotError(Exception):
    """Base of all faults of :mod:`rce_robot`; the text is fit for an ``ER``."""


class UnreadableError(RobotError):
    """A data message is not what its interface carries."""


class MisdirectedError(RobotError):
    """A data message is for no interface, for one of another class, or for one that only sends."""


class BusyError(RobotError):
    """Too much waits already."""
