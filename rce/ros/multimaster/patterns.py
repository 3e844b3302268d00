r"""Patterns of names: ``*`` stands for anything, upper and lower case are alike. Pure.

On the wire, fkie's sync sends its patterns as one regular expression: alternatives ``\A...\Z`` with ``.*``
for each ``*``. Only that form is accepted here: any other expression from the network could keep a machine
busy for hours. A filter of another form lets everything pass; the peer filters the result again.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

_BEGIN, _END = r"\A", r"\Z"
_STARS = re.compile(r"\*+")
_SPECIAL = frozenset("[](){}+?|^$\\")


class Patterns:
    """A set of patterns."""

    def __init__(self, patterns: Iterable[str] = ()) -> None:
        self._patterns = tuple(dict.fromkeys(stripped for text in patterns if (stripped := text.strip())))
        self._parts = [_STARS.sub("*", pattern.lower()).split("*") for pattern in self._patterns]

    def __bool__(self) -> bool:
        return bool(self._patterns)

    def __len__(self) -> int:
        return len(self._patterns)

    def __iter__(self) -> Iterator[str]:
        return iter(self._patterns)

    def __repr__(self) -> str:
        return f"Patterns({list(self._patterns)!r})"

    def match(self, name: str) -> bool:
        """Return whether a whole name fits one of the patterns."""
        lowered = name.lower()
        return any(_fits(parts, lowered) for parts in self._parts)

    def to_wire(self) -> str:
        """Write the regular expression; empty for no patterns."""
        return "|".join(f"{_BEGIN}{pattern.replace('*', '.*')}{_END}" for pattern in self._patterns)

    @classmethod
    def from_wire(cls, expression: str) -> Patterns | None:
        """Read a regular expression; None if it is not of the known form."""
        if not expression:
            return cls()
        if not expression.startswith(_BEGIN) or not expression.endswith(_END):
            return None
        bodies = expression[len(_BEGIN) : -len(_END)].split(f"{_END}|{_BEGIN}")
        patterns = [body.replace(".*", "*") for body in bodies]
        return None if any(_SPECIAL & set(pattern) for pattern in patterns) else cls(patterns)


def _fits(parts: list[str], name: str) -> bool:
    """Match greedily from the left; linear in the name's length for each part."""
    if len(parts) == 1:
        return parts[0] == name
    first, *middle, last = parts
    if len(name) < len(first) + len(last) or not name.startswith(first) or not name.endswith(last):
        return False
    position, end = len(first), len(name) - len(last)
    for part in middle:
        found = name.find(part, position, end)
        if found < 0:
            return False
        position = found + len(part)
    return True
