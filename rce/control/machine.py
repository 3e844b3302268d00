"""Resources of processes and machines, as task sets report them, and what the master assumes about them.

The kernel is asked directly: a library for it would cost each task set 4 MB.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

MEGABYTE = 1 << 20
"""Bytes of 1 MB, wherever memory is given in MB."""
MIN_MEMORY = 32 * MEGABYTE
"""Least memory of a container (bytes): its environment alone needs most of this."""
MEMORY_PER_SLOT = 64 * MEGABYTE
"""A machine offers one slot for so many bytes of its memory, unless its operator says otherwise."""

_STATM = Path("/proc/self/statm")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


def cpu_seconds() -> float:
    """Return the processor time that all threads of this process have used."""
    return time.process_time()


def resident_bytes() -> int:
    """Return how much memory of this process is resident; 0 where there is no ``/proc``."""
    try:
        return int(_STATM.read_text().split()[1]) * _PAGE_BYTES
    except FileNotFoundError:
        return 0


def machine_memory() -> int:
    """Return the size of this machine's memory in bytes."""
    return os.sysconf("SC_PHYS_PAGES") * _PAGE_BYTES
