"""Makes texts of other users safe to print on a terminal.

A terminal interprets control codes in its output: it moves its cursor, renames its window, writes to its
user's clipboard. The output of other users' nodes must not contain them.
"""

from __future__ import annotations

import re

REPLACEMENT = "\N{REPLACEMENT CHARACTER}"
_CONTROL = "\x00-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069"
"""Codes that a terminal interprets, and those that change the direction of the text after them."""
_ANY = re.compile(f"[{_CONTROL}]")
_COLOUR = r"\x1b\[[0-9;]*m"
_ALL_BUT_COLOURS = re.compile(rf"({_COLOUR}|\r?\n|\t)|[{_CONTROL}]")


def one_line(text: str) -> str:
    """Replace everything that a terminal would interpret, line ends too."""
    return _ANY.sub(REPLACEMENT, text)


def for_terminal(text: str) -> str:
    """Replace everything that a terminal would interpret, except line ends, tabs and colours."""
    return _ALL_BUT_COLOURS.sub(lambda found: found[1] or REPLACEMENT, text)
