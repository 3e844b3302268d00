"""The process of a member of etcd that a command runs."""

from __future__ import annotations

import asyncio
import contextlib
import os
from functools import partial
from typing import TYPE_CHECKING

from rce.aio.tasks import cancel_and_wait
from rce.services import etcd
from rce.supervision.process import end_with
from rce_master.cluster.members import ClusterError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from pathlib import Path

END_S = 20.0
"""How long etcd may take to end. It waits up to 7 s for its clients and 7 s for a new leader; but release 3.4
may wait 15 minutes for a member whose machine was lost, and all that it acknowledged is on the disk."""


def find_etcd() -> str:
    """Return the path of etcd.

    Raises:
        ClusterError: It is not installed, or too old.
    """
    try:
        return etcd.find_etcd()
    except etcd.EtcdProgramError as error:
        raise ClusterError(str(error)) from None


async def start_etcd(
    config: Path, owner: tuple[int | None, int | None] = (None, None)
) -> asyncio.subprocess.Process:
    """Start etcd; it does not outlive this process.

    Args:
        config: Its configuration.
        owner: The user and group that it runs as; None: those of this process.

    Raises:
        ClusterError: It is not installed, or too old.
    """
    user, group = owner
    return await asyncio.create_subprocess_exec(
        *(find_etcd(), "--config-file", str(config)),
        stdin=asyncio.subprocess.DEVNULL,
        user=user,
        group=group,
        preexec_fn=partial(end_with, os.getpid()),
    )


async def end_etcd(process: asyncio.subprocess.Process) -> int:
    """End etcd, or kill it if it does not end within :data:`END_S`; return its exit code."""
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    try:
        async with asyncio.timeout(END_S):
            return await process.wait()
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        return await process.wait()


async def until_ends(
    process: asyncio.subprocess.Process, ending: asyncio.Event, steps: Callable[[], Awaitable[None]]
) -> int:
    """Run steps beside etcd until it ends by itself, or is ended; return its exit code.

    Args:
        process: Of etcd; it has ended when this returns or raises.
        ending: Set when it is to be ended.
        steps: What to do meanwhile; a fault of them is raised at once.
    """
    exited, asked = asyncio.ensure_future(process.wait()), asyncio.ensure_future(ending.wait())
    doing = asyncio.ensure_future(steps())
    try:
        await asyncio.wait((exited, asked, doing), return_when=asyncio.FIRST_COMPLETED)
        if doing.done():
            doing.result()
        await asyncio.wait((exited, asked), return_when=asyncio.FIRST_COMPLETED)
    finally:
        await cancel_and_wait(exited, asked, doing)
        code = await end_etcd(process)
    return code
