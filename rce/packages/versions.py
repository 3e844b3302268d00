"""Order of versions, and the parts of a package's name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

T = TypeVar("T")

_Label = tuple[tuple[bool, int, str], ...]
VersionKey = tuple[bool, tuple[int, ...], bool, _Label, str]


def split_package(text: str) -> tuple[str, str]:
    """Split a node's package, ``NAME`` or ``NAME@VERSION``; without a version the second part is empty."""
    name, _, version = text.partition("@")
    return name, version


def version_key(version: str) -> VersionKey:
    """Make a sort key: numbers count as numbers, and versions with a label come before those without.

    Args:
        version: As :func:`rce.model.names.is_version` allows it.
    """
    numbers, dash, label = version.partition("-")
    parts = [int(part) for part in numbers.split(".")]
    while len(parts) > 1 and not parts[-1]:
        parts.pop()
    words = tuple(
        (not word.isdigit(), int(word) if word.isdigit() else 0, word) for word in label.split(".") if word
    )
    return not dash, tuple(parts), not dash, words, version


def newest(items: Iterable[T], version: Callable[[T], str]) -> T | None:
    """Return the newest version: the highest release; one with a label only if there are no releases."""
    return max(items, key=lambda item: version_key(version(item)), default=None)
