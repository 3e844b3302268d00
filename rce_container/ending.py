"""Ends the containers that a killed container task set left, without a master."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from pathlib import Path

from rce.config import run_dir
from rce.control import ContentError, MachineInfo
from rce.control_channel.contents import Piece
from rce.link import LinkAcceptor, remove_stale_sockets
from rce_container.environment import proc
from rce_container.exceptions import StateBusyError
from rce_container.folder import StateFolder
from rce_container.limits import choose_limiter
from rce_container.manager import Manager
from rce_container.packages.cache import PackageCache
from rce_container.packages.supply import Library
from rce_container.runtimes.base import Runtime
from rce_container.runtimes.namespace import NamespaceRuntime
from rce_container.runtimes.podman import PodmanRuntime
from rce_container.runtimes.process import ProcessRuntime
from rce_container.settings import ContainerSettings

RUNNING_TIMEOUT_S = 60.0
"""Seconds; longer than a task set takes to shut down."""
KILLED_TIMEOUT_S = 30.0
"""Seconds for the end of a killed task set; the kernel may have much to clean up."""
_BUSY_PAUSE_S = 0.05
_log = logging.getLogger(__name__)


async def end_containers(
    settings: ContainerSettings, state_dir: Path, *, timeout: float = RUNNING_TIMEOUT_S
) -> None:
    """End the containers of a state directory as their task set would, and remove their remains.

    Wait for a task set that still uses the directory: it may be about to end. Kill a task set that does not
    end, because it hangs or was stopped (SIGSTOP).

    Args:
        settings: How long nodes may take to end.
        state_dir: The task set's state directory.
        timeout: Seconds to wait for a task set.

    Raises:
        ContainerError: The directory cannot be used, or a task set uses it and does not end.
    """
    remove_stale_sockets(run_dir(), "robot_*.sock")
    async with _taken(state_dir, timeout) as state, contextlib.AsyncExitStack() as stack:
        limiter = await asyncio.to_thread(choose_limiter, state.token, state.cgroups)
        stack.callback(limiter.close)
        runtimes: dict[str, Runtime] = {
            one.name: one for one in (NamespaceRuntime(), PodmanRuntime(), ProcessRuntime())
        }
        for one in runtimes.values():
            stack.callback(one.close)
        manager = Manager(
            name=state.name(""),
            info=MachineInfo(name=settings.machine),
            settings=settings,
            runtimes=runtimes,
            runtime=runtimes[ProcessRuntime.name],
            state=state,
            acceptor=LinkAcceptor(),
            links=("", 0),
            limiter=limiter,
            library=Library(cache=PackageCache(state.library, _no_master, space=settings.bundle_space)),
        )
        quit_ = asyncio.Event()
        quit_.set()
        await manager.run(lambda: None, quit_)


@contextlib.asynccontextmanager
async def _taken(state_dir: Path, timeout: float) -> AsyncIterator[StateFolder]:
    """Lock a state directory as soon as no other process holds it; kill a process that holds it too long."""
    folder = StateFolder(state_dir, run_dir())
    state = await _take_within(folder, timeout)
    if state is None and (owner := folder.owner()) is not None:
        _log.warning("rce-container (process %d) has not ended within %g s and is killed", owner.pid, timeout)
        proc.kill(owner)
        state = await _take_within(folder, KILLED_TIMEOUT_S)
    try:
        yield state or folder.__enter__()
    finally:
        folder.__exit__()


async def _take_within(folder: StateFolder, timeout: float) -> StateFolder | None:
    """Lock a state directory; return None if another process still holds it after some seconds."""
    deadline = asyncio.get_running_loop().time() + timeout
    while True:
        try:
            return folder.__enter__()
        except StateBusyError:
            if asyncio.get_running_loop().time() > deadline:
                return None
            await asyncio.sleep(_BUSY_PAUSE_S)


async def _no_master(sha256: str, offset: int) -> Piece:  # noqa: ARG001 - as a cache asks
    raise ContentError("containers that end get no packages")
