"""Settings of processes that the kernel keeps. Linux only; without effect elsewhere."""

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
"""When memory runs out, the kernel kills containers before the engine, whose processes have the score 0."""
OF_NODES = 600
"""The kernel kills nodes before the environment, which has to report it."""

_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36
_ATTEMPTS = 20
_ATTEMPT_PAUSE_S = 0.0002
_STRIKES = 100
_STRIKE_PAUSE_S = 0.02


def set_oom_score(score: int, pid: int | None = None) -> None:
    """Set the out-of-memory score of this process or another one.

    Args:
        score: The score of the process, and of the children that it starts from then on; see
            :data:`OF_ENVIRONMENT`.
        pid: Another process of the same user. Waits briefly for one that is just executing a program.
    """
    for _ in range(_ATTEMPTS):
        try:
            Path(f"/proc/{pid or 'self'}/oom_score_adj").write_text(str(score))
        except PermissionError:  # it is still as protected as the process that forked it
            time.sleep(_ATTEMPT_PAUSE_S)
        except OSError:  # not Linux, or the process is gone
            return
        else:
            return


def set_rlimits(rlimits: Mapping[int, int]) -> None:
    """Limit this process and its future children; stricter limits stay.

    Args:
        rlimits: Limits by the numbers of :mod:`resource`.
    """
    for number, limit in rlimits.items():
        _, hard = resource.getrlimit(number)
        if hard == resource.RLIM_INFINITY or limit < hard:
            resource.setrlimit(number, (limit, limit))


def become_subreaper() -> None:
    """Adopt the orphans of descendants, and end when the parent process ends."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)
    _prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


async def kill_marked(mark: str, *, variable: str = proc.MARK) -> bool:
    """Kill -9 all processes that carry a mark, and their new children.

    Returns:
        Whether no process is left; False after two seconds of attempts.
    """
    for _ in range(_STRIKES):
        if not proc.strike(mark, variable=variable):
            return True
        await asyncio.sleep(_STRIKE_PAUSE_S)
    return False


def _prctl(option: int, value: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)
