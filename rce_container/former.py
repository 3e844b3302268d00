"""What earlier managers left: containers that are adopted, and remains that are removed."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from typing import TYPE_CHECKING, Protocol

from rce.model import EndpointId
from rce_container.environment import messages as m
from rce_container.environment import proc
from rce_container.environment.channel import connect
from rce_container.environment.exceptions import ChannelError
from rce_container.environment.process import kill_marked
from rce_container.exceptions import ContainerError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_container.environment.proc import Process
    from rce_container.folder import ContainerFolder, Record, StateFolder
    from rce_container.launcher import Launcher
    from rce_container.limits import Limiter
    from rce_container.settings import ContainerSettings
    from rce_container.volumes.store import VolumeStore

_log = logging.getLogger(__name__)


class Adopter(Protocol):
    """Adopts a container that still runs."""

    async def adopt(self, folder: ContainerFolder, record: Record, process: Process) -> None:
        """Adopt a container, or kill it if it does not answer."""


class FormerContainers:
    """The containers of the managers before this one.

    Args:
        state: The state directory.
        settings: How containers are run.
        limiter: Enforces the containers' limits.
        launcher: Removes what it made for a container.
        volumes: Learns which volumes the containers have.
        release: Takes the volumes of a container that has ended.
    """

    def __init__(
        self,
        state: StateFolder,
        settings: ContainerSettings,
        limiter: Limiter,
        launcher: Launcher,
        volumes: VolumeStore,
        release: Callable[[str], None],
    ) -> None:
        self._volumes = volumes
        self._release = release
        self._state = state
        self._settings = settings
        self._limiter = limiter
        self._launcher = launcher

    async def take_over(self, adopter: Adopter, background: asyncio.TaskGroup) -> None:
        """Have those adopted that still run; return when all have answered.

        Args:
            adopter: Adopts them.
            background: Owns the tasks that remove what the others left.
        """
        folders = await asyncio.to_thread(self._state.existing)
        incarnation_ids = {folder.incarnation_id for folder in folders}
        await self._sweep_control_groups(incarnation_ids)
        await asyncio.to_thread(self._state.archive.settle, incarnation_ids, time.time())
        async with asyncio.TaskGroup() as tasks:
            for folder in folders:
                record = folder.read_record()
                if record is not None:
                    user = EndpointId.parse(record.id).user
                    self._volumes.adopt(user, folder.incarnation_id, record.volumes)
                process = proc.read(record.pid) if record is not None else None
                if (
                    record is None
                    or process is None
                    or process.start != record.start
                    or self._launcher.runtime_of(record).is_starting(record)
                ):
                    background.create_task(self._prune(folder), name=f"prune {folder.incarnation_id}")
                else:
                    tasks.create_task(adopter.adopt(folder, record, process))

    async def prune_logs(self) -> None:
        """Periodically remove the logs of containers that ended long ago."""
        while True:
            await asyncio.to_thread(self._state.archive.prune, time.time())
            await asyncio.sleep(self._settings.prune_interval)

    async def _prune(self, folder: ContainerFolder) -> None:
        """Remove the remains of an ended container."""
        with contextlib.suppress(OSError, ChannelError, TimeoutError):
            # It may still run, if its manager ended before it wrote the record; or it may be ending just now.
            channel = await connect(str(folder.control_socket))
            try:
                channel.send(m.encode(m.Stop()))
                async with asyncio.timeout(self._settings.stop_timeout):
                    while await channel.receive() is not None:
                        pass
            finally:
                channel.close()
        await kill_marked(folder.incarnation_id)
        await self._launcher.undo(folder.incarnation_id)
        await asyncio.to_thread(folder.remove)
        await asyncio.to_thread(self._state.archive.settle_one, folder.incarnation_id, time.time())
        self._release(folder.incarnation_id)

    async def _sweep_control_groups(self, keep: set[str]) -> None:
        """Remove the control groups of containers that have no other remains."""
        try:
            await asyncio.to_thread(self._limiter.sweep, keep)
        except (ContainerError, OSError) as error:
            _log.error("what earlier containers left cannot be removed: %s", error)
