"""Chooses how limits are enforced on this machine."""

from __future__ import annotations

import logging
from pathlib import Path

from rce_container.exceptions import LimitsUnavailableError
from rce_container.limits.base import Limiter
from rce_container.limits.cgroup1 import Cgroup1
from rce_container.limits.cgroup2 import Cgroup2
from rce_container.limits.hierarchy import PROC
from rce_container.limits.rlimit import RlimitLimiter

_log = logging.getLogger(__name__)

_ESSENTIAL = frozenset({"cpu", "memory", "processes"})


def choose_limiter(token: str, ledger: Path, proc: Path = PROC) -> Limiter:
    """Find the best way that works: cgroups of the more capable version, else limits of each process.

    Args:
        token: A permanent name of the task set on this machine.
        ledger: A file of the task set, for where its cgroups are.
        proc: This process in ``/proc``.
    """
    working: list[Limiter] = []
    reasons = []
    candidates: tuple[Limiter, ...] = (Cgroup2(token, ledger, proc), Cgroup1(token, ledger, proc))
    for limiter in candidates:
        try:
            limiter.probe()
        except LimitsUnavailableError as error:
            reasons.append(f"{limiter.name}: {error}")
            continue
        working.append(limiter)
        if not limiter.missing & _ESSENTIAL:
            break
    chosen = min(working, key=lambda one: len(one.missing), default=RlimitLimiter("; ".join(reasons)))
    for limiter in working:
        if limiter is not chosen:
            limiter.close()
    if chosen.detail:
        _log.warning("%s", chosen.detail)
    return chosen
