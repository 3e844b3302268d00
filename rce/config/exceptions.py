"""Errors of config files, the settings and the secret."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence


class Fault(NamedTuple):
    """One fault of a file."""

    place: str
    """Where, such as ``interfaces[3].iType`` or ``line 4, column 7``; empty for the file as a whole."""
    problem: str

    def __str__(self) -> str:
        return f"{self.place}: {self.problem}" if self.place else self.problem


class ConfigError(Exception):
    """A config or settings file is refused.

    Attributes:
        source: The file's name.
        faults: Every fault that was found in it; never empty.
    """

    def __init__(self, source: str, faults: Sequence[Fault]) -> None:
        super().__init__(source, tuple(faults))
        self.source = source
        self.faults = tuple(faults)

    def __str__(self) -> str:
        return "\n".join(f"{self.source}: {fault}" for fault in self.faults)


class SecretError(Exception):
    """The shared secret is missing, empty or readable by others."""


class RunDirError(Exception):
    """The folder for sockets cannot be used, for instance because another user owns it."""


class LogFileError(Exception):
    """The file of a program's log cannot be written."""


class ShippedFileError(Exception):
    """A folder that is part of the project was not found."""
