"""Keeps the memory of large messages in the process instead of giving it back after each.

glibc returns freed blocks at the end of the heap to the kernel and maps really large ones again each time.
A process that passes on 10 MB messages then spends most of its time in page faults: five of six milliseconds
per copy. Imported and used only by processes that see such messages.
"""

from __future__ import annotations

import ctypes
import logging
from functools import cache

_log = logging.getLogger(__name__)

_LARGEST_KEPT = 32 * 2**20
MOST_KEPT = 128 * 2**20
"""Bytes of freed memory at the end of the heap that stay in the process."""

_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3


@cache
def keep_large_blocks() -> None:
    """Make the allocator keep up to 128 MiB of freed memory. Without effect if it is not glibc's."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    mallopt(_M_MMAP_THRESHOLD, _LARGEST_KEPT)
    mallopt(_M_TRIM_THRESHOLD, MOST_KEPT)
    _log.debug("the memory of large messages is kept")


def give_back_free_memory() -> bool:
    """Return freed memory to the kernel, also between blocks in use.

    100 MB take some milliseconds, in which nothing else can be allocated.

    Returns:
        Whether anything was given back; False where the allocator is not glibc's.
    """
    try:
        return bool(ctypes.CDLL(None).malloc_trim(0))
    except (OSError, AttributeError):
        return False
