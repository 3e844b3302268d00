"""What is asked of the kernel about processes. Linux only; elsewhere nothing happens."""

from __future__ import annotations

import asyncio
import ctypes
import signal
import sys

from rce_container.environment import proc

_PR_SET_PDEATHSIG = 1
_PR_SET_DUMPABLE = 4
_PR_SET_CHILD_SUBREAPER = 36
_STRIKES = 100
_STRIKE_PAUSE_S = 0.02


def keep_to_oneself() -> None:
    """Keep other processes of the same user, the container's nodes, from looking into this one.

    It holds the sockets of the container's control and links and the links' tokens.
    """
    _prctl(_PR_SET_DUMPABLE, 0)


def take_in_orphans() -> None:
    """Become the parent of what descendants leave behind, and end when the own parent ends."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)
    _prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


async def strike_all(mark: str, *, variable: str = proc.MARK) -> bool:
    """Kill -9 all that carries a mark, and what that forks meanwhile.

    Returns:
        Whether nothing is left; False after two seconds of trying.
    """
    for _ in range(_STRIKES):
        if not proc.strike(mark, variable=variable):
            return True
        await asyncio.sleep(_STRIKE_PAUSE_S)
    return False


def _prctl(option: int, value: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)
