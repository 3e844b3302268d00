"""Describes a robot's request for the audit log: names, never values (pure)."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rce_master.state.commands import Command

SHOWN = 5
"""How many of a request's commands are named; the others are counted."""

_UPPER = re.compile(r"(?<!^)(?=[A-Z])")
_NAMES = ("container", "endpoint", "tag", "name", "tag_a", "tag_b")


def describe(commands: Sequence[Command]) -> str:
    """Return a short description of the commands of one request."""
    words = [_describe(command) for command in commands[:SHOWN]]
    more = len(commands) - len(words)
    return ", ".join(words) + (f", and {more} more" if more else "")


def _describe(command: Command) -> str:
    action = _UPPER.sub(" ", type(command).__name__).lower()
    names = [getattr(command, name, "") for name in _NAMES]
    names += [_tag_of(getattr(command, part, None)) for part in ("node", "interface")]
    return f"{action} {' '.join(name for name in names if name)}"


def _tag_of(part: Any) -> str:
    return str(getattr(part, "tag", ""))
