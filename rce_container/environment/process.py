"""What the environment asks of the kernel about itself. Linux only; elsewhere nothing happens."""

from __future__ import annotations

import ctypes
import signal
import sys

_PR_SET_PDEATHSIG = 1
_PR_SET_DUMPABLE = 4
_PR_SET_CHILD_SUBREAPER = 36


def keep_to_oneself() -> None:
    """Keep other processes of the same user, the container's nodes, from looking into this one.

    It holds the sockets of the container's control and links and the links' tokens.
    """
    _prctl(_PR_SET_DUMPABLE, 0)


def take_in_orphans() -> None:
    """Become the parent of all processes that a descendant leaves behind, and end when the own parent ends."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)
    _prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _prctl(option: int, value: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)
