"""What a forked process is called in lists of processes."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path

from rce_container.nursery import kernel

ROOM = 512
"""Bytes that a program must leave in its arguments for titles of its children."""

_ARGUMENTS_START, _ARGUMENTS_END = 45, 46
"""Fields of ``/proc/PID/stat`` after the program's name."""


def padding() -> str:
    """An argument that does nothing but leave room for titles."""
    return "-" * ROOM


def set_title(words: Sequence[str], name: str) -> None:
    """Show other words as this process's command line, cut to the room there is, and another name.

    Args:
        words: The command line to show.
        name: The program's name; 15 bytes of it are shown.
    """
    stat = Path("/proc/self/stat").read_bytes()
    fields = stat[stat.rindex(b")") + 2 :].split()
    start, end = int(fields[_ARGUMENTS_START]), int(fields[_ARGUMENTS_END])
    text = b"".join(word.encode(errors="replace") + b"\0" for word in words)
    # The last byte stays zero: else the kernel takes what follows for a part of it.
    ctypes.memmove(start, text[: end - start - 1].ljust(end - start, b"\0"), end - start)
    kernel.set_name(name)
