"""Texts that strangers wrote, made fit for a person's terminal.

A terminal obeys what is printed on it: it moves its cursor, renames its window, writes into its user's
clipboard. Nodes of others shall not be able to ask it.
"""

from __future__ import annotations

import re

REPLACEMENT = "\N{REPLACEMENT CHARACTER}"
_CONTROL = "\x00-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069"
"""Codes that a terminal obeys, and those that turn the direction of what follows."""
_ANY = re.compile(f"[{_CONTROL}]")
_COLOUR = r"\x1b\[[0-9;]*m"
_ALL_BUT_COLOURS = re.compile(rf"({_COLOUR}|\r?\n|\t)|[{_CONTROL}]")


def one_line(text: str) -> str:
    """Replace all that a terminal would obey, line ends too."""
    return _ANY.sub(REPLACEMENT, text)


def for_terminal(text: str) -> str:
    """Replace all that a terminal would obey, but line ends, tabs and colours."""
    return _ALL_BUT_COLOURS.sub(lambda found: found[1] or REPLACEMENT, text)
