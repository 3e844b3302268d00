"""A piece of work that is always the same: its processor time tells how fast the computer is at the moment.

A computer that shares its processor with others, as a virtual machine does, is faster at some hours than at
others; processor times and delays of the same system then differ too. Python's version changes the work's
time little: it is done by zlib, which is a library of the computer.
"""

from __future__ import annotations

import time
import zlib
from functools import cache
from random import Random

from rce_fleet.experiments.results import MACHINE, NOT_ANY, Condition

ROUND = "round"
"""Factor: the round of runs in which the work was done."""
_SIZE = 1 << 18
_TIMES = 3
_LEVEL = 6


def work_condition(number: int) -> Condition:
    """Return the condition of the work's times in a round of runs."""
    return Condition.of(MACHINE, NOT_ANY, NOT_ANY, **{ROUND: number})


def processor_time() -> float:
    """Do the work, some 50 ms, and return the processor time that this thread used for it, seconds."""
    data = _data()
    began = time.thread_time()
    for _ in range(_TIMES):
        zlib.compress(data, _LEVEL)
    return time.thread_time() - began


@cache
def _data() -> bytes:
    """Return what is compressed: by half, as each byte has four random bits."""
    return bytes(Random(1).choices(range(16), k=_SIZE))  # noqa: S311 - not for secrets
