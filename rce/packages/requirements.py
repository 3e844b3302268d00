"""Rules for a package's ``requirements.txt``.

It may name distributions only, from the index that the machine's operator chose: with options, addresses and
paths, a user could have the machine fetch, or run, anything.
"""

from __future__ import annotations

import re
from typing import NamedTuple

FILE_NAME = "requirements.txt"

# Possessive, so that no line takes longer than its length.
_DISTRIBUTION = re.compile(
    r"[A-Za-z0-9][A-Za-z0-9._-]*+\s*+(?:\[[A-Za-z0-9._,\s-]*+\])?+\s*+(?:[(<>=!~][0-9A-Za-z.*+!<>=~,()\s-]*+)?"
)
_MARKER = re.compile(r"[A-Za-z0-9_.'\"<>=!~,()\s-]*+")
_HASH_OPTION = re.compile(r"\s--hash=")
_HASH = re.compile(r"sha(?:256|384|512):[0-9a-f]+")
_COMMENT = re.compile(r"(?:^|\s)#.*$")
_SHOWN = 80


class Requirements(NamedTuple):
    """A ``requirements.txt`` that was read."""

    lines: tuple[str, ...]
    """The valid lines, one distribution each."""
    faults: tuple[str, ...]
    """The faults, with the number of the line."""


def read_requirements(text: str) -> Requirements:
    """Read a ``requirements.txt``."""
    lines, faults = [], []
    for number, line in _logical_lines(text):
        if _is_distribution(line):
            lines.append(line)
        else:
            faults.append(
                f"{FILE_NAME} line {number}: {line[:_SHOWN]!r} is not the name of a distribution with its"
                " versions; options, addresses and paths are not taken"
            )
    return Requirements(tuple(lines), tuple(faults))


def _is_distribution(line: str) -> bool:
    what, *hashes = _HASH_OPTION.split(line)
    distribution, _, marker = what.partition(";")
    return (
        "--" not in what
        and _DISTRIBUTION.fullmatch(distribution.strip()) is not None
        and _MARKER.fullmatch(marker) is not None
        and all(_HASH.fullmatch(text.strip()) for text in hashes)
    )


def _logical_lines(text: str) -> list[tuple[int, str]]:
    found: list[tuple[int, str]] = []
    held, first = "", 0
    for number, raw in enumerate([*text.splitlines(), ""], 1):
        line = _COMMENT.sub("", raw)
        first = first if held else number
        if line.endswith("\\"):
            held += line[:-1] + " "
            continue
        whole = (held + line).strip()
        held = ""
        if whole:
            found.append((first, whole))
    return found
