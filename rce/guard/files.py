"""The limit of open files and sockets of this process."""

from __future__ import annotations

import logging
import resource

_ENOUGH = 1 << 20
_log = logging.getLogger(__name__)


def raise_file_limit() -> int:
    """Raise the limit of open files to the most that the system allows, also for child processes.

    The usual soft limit of 1024 is there for old programs; a server needs a socket for each of its clients.

    Returns:
        The new limit.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _ENOUGH if hard == resource.RLIM_INFINITY else min(hard, _ENOUGH)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return soft
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    except (OSError, ValueError) as error:
        _log.info("this process can have only %d files open: %s", soft, error)
        return soft
    return wanted
