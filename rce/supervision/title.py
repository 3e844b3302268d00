"""A forked process's entries in ``/proc``: its command line, its variables, its name."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

ROOM = 4096
"""Bytes that a program leaves in its arguments, and in its variables, for its children's."""
ROOM_VARIABLE = "RCE_ROOM"

_PR_SET_NAME: Final = 15
_ARGUMENTS = (45, 46)
"""Fields of ``/proc/PID/stat`` after the program's name: where the memory begins and ends."""
_VARIABLES = (47, 48)


def padding() -> str:
    """Return an argument, or a variable's value, that only leaves room."""
    return "-" * ROOM


def set_title(words: Sequence[str], name: str) -> None:
    """Change this process's command line, cut to the available room, and its name.

    Args:
        words: The command line to show.
        name: The program's name; 15 bytes of it are shown.
    """
    _show(_ARGUMENTS, words)
    text = ctypes.create_string_buffer(os.fsencode(name))
    ctypes.CDLL(None).prctl(_PR_SET_NAME, ctypes.c_ulong(ctypes.addressof(text)), 0, 0, 0)


def show_variables(environ: Mapping[str, str]) -> None:
    """Change the variables that this process appears to have been started with, as far as they fit.

    The original ones must not be in use any more.
    """
    _show(_VARIABLES, (f"{name}={value}" for name, value in environ.items()))


def _show(place: tuple[int, int], words: Iterable[str]) -> None:
    stat = Path("/proc/self/stat").read_bytes()
    fields = stat[stat.rindex(b")") + 2 :].split()
    start, end = (int(fields[number]) for number in place)
    text = b"".join(word.encode(errors="replace") + b"\0" for word in words)
    # The last byte stays zero: otherwise the kernel takes the bytes after it for a part of it.
    ctypes.memmove(start, text[: end - start - 1].ljust(end - start, b"\0"), end - start)
