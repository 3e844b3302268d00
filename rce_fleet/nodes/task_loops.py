"""Compiles the loops that choose tasks, beside a fleet manager that goes on with the plain forms meanwhile.

Another process compiles them into numba's cache, unless ``rce compile`` has done it: in the manager's own
process its requests would wait. On the volume ``fleet`` the cache outlives the container.
"""

from __future__ import annotations

import asyncio
import os
import sys
from asyncio.subprocess import PIPE
from pathlib import Path
from typing import TYPE_CHECKING

from rce_fleet.compiled import compile_kernels
from rce_fleet.nodes.known_robots import VOLUME_VARIABLE
from rce_fleet.tasks.matching_loops import match_rows
from rce_fleet.tasks.travel_loops import measure_ways

if TYPE_CHECKING:
    import logging

COMPILE_FROM = 100
"""Robots from which on the loops are compiled. They take 100 MB, and scipy is fast enough for fewer."""
LOOPS = (match_rows, measure_ways)
_CACHE_VARIABLE = "NUMBA_CACHE_DIR"
_CACHE = "compiled"
"""Folder on the volume."""
_LEAST_PRIORITY = 19


async def compile_beside(log: logging.Logger) -> None:
    """Compile the loops in another process, then use them in this one; without numba, log a line.

    numba is imported in a thread: that takes a second. Cancelling ends the other process.

    Args:
        log: Says that the plain forms stay in use, if the loops cannot be compiled.
    """
    if (volume := os.environ.get(VOLUME_VARIABLE, "")) and _CACHE_VARIABLE not in os.environ:
        os.environ[_CACHE_VARIABLE] = str(Path(volume, _CACHE))
    command = (sys.executable, "-P", "-m", __name__)
    try:
        # It ends with its input, also when this process is killed.
        process = await asyncio.create_subprocess_exec(*command, stdin=PIPE)
    except OSError as error:
        log.warning("tasks are chosen without compiled loops: %s", error)
        return
    try:
        status = await process.wait()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    if status:
        log.warning(
            "tasks are chosen without compiled loops: the process that compiles ended with %d", status
        )
        return
    await asyncio.to_thread(compile_kernels, LOOPS)


if __name__ == "__main__":
    import threading

    from rce_fleet.nodes.plan_worker import end_with_input

    os.nice(_LEAST_PRIORITY)
    threading.Thread(target=end_with_input, daemon=True).start()
    compile_kernels(LOOPS)
