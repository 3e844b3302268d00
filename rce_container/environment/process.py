"""What is asked of the kernel about processes. Linux only; elsewhere nothing happens."""

from __future__ import annotations

import asyncio
import ctypes
import resource
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from rce_container.environment import proc

OF_ENVIRONMENT = 300
"""When memory has run out, containers die before the engine, of which a process has the score 0."""
OF_NODES = 600
"""And nodes die before the environment that would have to tell of it."""

_PR_SET_PDEATHSIG = 1
_PR_SET_DUMPABLE = 4
_PR_SET_CHILD_SUBREAPER = 36
_ATTEMPTS = 20
_ATTEMPT_PAUSE_S = 0.0002
_STRIKES = 100
_STRIKE_PAUSE_S = 0.02


def set_undumpable() -> None:
    """Keep other processes of the same user, the container's nodes, from looking into this one.

    It holds the sockets of the container's control and links and the links' tokens.
    """
    _prctl(_PR_SET_DUMPABLE, 0)


def set_oom_score(score: int, pid: int | None = None) -> None:
    """Offer this process, or another one, to the kernel for the time when memory has run out.

    Args:
        score: How much it is offered, and what it starts from then on; see :data:`OF_ENVIRONMENT`.
        pid: Another process of the same user. One that executes a program just now is waited for, briefly.
    """
    for _ in range(_ATTEMPTS):
        try:
            Path(f"/proc/{pid or 'self'}/oom_score_adj").write_text(str(score))
        except PermissionError:  # it is still as closed to others as the one that forked it
            time.sleep(_ATTEMPT_PAUSE_S)
        except OSError:  # not Linux, or the process is gone
            return
        else:
            return


def set_rlimits(rlimits: Mapping[int, int]) -> None:
    """Limit this process and each one that it starts, as far as it is not limited further already.

    Args:
        rlimits: Limits by the numbers of :mod:`resource`.
    """
    for number, limit in rlimits.items():
        _, hard = resource.getrlimit(number)
        if hard == resource.RLIM_INFINITY or limit < hard:
            resource.setrlimit(number, (limit, limit))


def become_subreaper() -> None:
    """Become the parent of what descendants leave behind, and end when the own parent ends."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)
    _prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


async def kill_marked(mark: str, *, variable: str = proc.MARK) -> bool:
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
