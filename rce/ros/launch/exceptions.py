"""Errors of launch files.

::

    LaunchError                 a launch is not possible
    +-- LaunchFileError         a launch file is wrong: file, line, element, reason
    LaunchValueError            a text is not what it must be; becomes a LaunchFileError
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple


class Place(NamedTuple):
    """Where an element stands."""

    file: str
    line: int
    """The first line is 1; 0 means the whole file."""
    tag: str = ""
    """The element's name; empty if the fault is not in one element."""

    def __str__(self) -> str:
        where = f"{self.file}:{self.line}" if self.line else self.file
        return f"{where}: <{self.tag}>" if self.tag else where


class LaunchError(Exception):
    """A launch is not possible."""


class LaunchFileError(LaunchError):
    """A launch file is wrong.

    Attributes:
        place: The element.
        reason: What is wrong, and what to do.
        included_from: The ``<include>`` elements that led to the file, the nearest first.
    """

    def __init__(self, place: Place, reason: str, included_from: tuple[Place, ...] = ()) -> None:
        super().__init__(place, reason, included_from)
        self.place = place
        self.reason = reason
        self.included_from = included_from

    def __str__(self) -> str:
        origins = (f"\n  included from {one.file}:{one.line}" for one in self.included_from)
        return f"{self.place}: {self.reason}" + "".join(origins)


class LaunchValueError(ValueError):
    """A text in a launch file is not what it must be. The reader of the element adds the place."""


@contextmanager
def errors_at(place: Place) -> Iterator[None]:
    """Turn errors about a text, a file or a package into a :class:`LaunchFileError` at a place."""
    try:
        yield
    except (ValueError, LookupError) as error:
        raise LaunchFileError(place, str(error)) from error
    except OSError as error:
        text = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        raise LaunchFileError(place, text) from error
