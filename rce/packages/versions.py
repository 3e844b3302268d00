"""Which version is the newest, and what a node means by the package it names."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

T = TypeVar("T")

_Label = tuple[tuple[bool, int, str], ...]
VersionKey = tuple[bool, tuple[int, ...], bool, _Label, str]


def split_package(text: str) -> tuple[str, str]:
    """Split what a node names, ``NAME`` or ``NAME@VERSION``; without a version the second is empty."""
    name, _, version = text.partition("@")
    return name, version


def version_key(version: str) -> VersionKey:
    """Make a sort key: numbers count as numbers, and whatever has a label comes before all that have none.

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
    """Choose the newest: of releases the highest; of those with a label only if there is nothing else."""
    return max(items, key=lambda item: version_key(version(item)), default=None)
