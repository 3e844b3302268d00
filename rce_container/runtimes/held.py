"""Containers with a holder for their namespaces and an environment forked by the fork server."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
from collections.abc import Sequence
from typing import Self

from rce_container.environment import proc
from rce_container.environment.logs.files import ENVIRONMENT_LOG, segment_path
from rce_container.exceptions import StartError
from rce_container.forkserver.messages import FAREWELL, Descriptors, SpawnRequest
from rce_container.forkserver.process import ForkServer, receive_credentials
from rce_container.runtimes.base import Handle, Order, Prepare
from rce_container.runtimes.shim import SHELL, spawn_shim

HOLDER = (SHELL, "-c", f'echo && read -r word && [ "$word" = {FAREWELL.decode().strip()} ]')
"""Reports that the namespaces and mounts exist, then waits for the environment's last message."""

_GENERATIONS = 4
"""Maximum number of generations between the shim and the holder: podman starts three processes in between."""


class HeldHandle(Handle):
    """A container whose namespaces exist before its environment does."""

    def __init__(
        self,
        process: proc.Process,
        popen: subprocess.Popen[bytes],
        request: SpawnRequest,
        fork_server: ForkServer,
    ) -> None:
        super().__init__(process, "", popen)
        self.failure = "its namespaces cannot be made"
        """The error text without a holder."""
        self._request = request
        self._fork_server = fork_server
        self._fds: dict[str, int] = {}
        """The environment's descriptors; owned by this object until they are sent."""

    @classmethod
    def start(
        cls, argv: Sequence[str], order: Order, request: SpawnRequest, fork_server: ForkServer, lock: int
    ) -> Self:
        """Start the shim, and with it the holder.

        Args:
            argv: Makes the namespaces and runs :data:`HOLDER` in them.
            order: The container.
            request: Its environment.
            fork_server: Makes the environment.
            lock: A descriptor that shim and holder keep open; -1 for none.

        Raises:
            StartError: It cannot be started.
        """
        log = segment_path(order.folder.logs, ENVIRONMENT_LOG, 0)
        try:
            lifeline, theirs = socket.socketpair()
            with theirs, contextlib.ExitStack() as undo:
                lifeline.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
                fds = {"lifeline": lifeline.detach()}
                undo.callback(_close_all, fds)
                fds["control"] = os.dup(order.control)
                fds["links"] = os.dup(order.links)
                fds["log"] = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
                streams = (theirs.fileno(), theirs.fileno())
                keep = () if lock < 0 else (lock,)
                popen, process = spawn_shim(order, argv, {"PATH": os.defpath}, streams, keep=keep)
                undo.pop_all()
        except OSError as error:
            raise StartError(f"its processes cannot be started: {error}") from error
        handle = cls(process, popen, request, fork_server)
        handle._fds = fds
        return handle

    async def launch(self, prepare: Prepare | None = None) -> None:
        """Wait for the namespaces, prepare them, and let the fork server make the environment."""
        try:
            self.namespaces_pid = await self._holder()
            holder = self._fds["holder"] = self._open_holder(self.namespaces_pid)
            if prepare is not None:
                await prepare(self.namespaces_pid)
            fds = self._fds
            descriptors = Descriptors(holder, -1, fds["lifeline"], fds["control"], fds["links"], fds["log"])
            self.environment = proc.read(await self._fork_server.spawn(self._request, descriptors))
        finally:
            self._close()

    def discard(self) -> None:
        """Kill the shim, and close what the environment would have had."""
        super().discard()
        self._close()

    def abandon(self) -> None:
        """Leave the container running; without an environment it ends."""
        self._close()
        super().abandon()

    async def _holder(self) -> int:
        with socket.socket(fileno=os.dup(self._fds["lifeline"])) as lifeline:
            said, pid = await receive_credentials(lifeline, 1)
        if not said or not pid:
            raise StartError(self.failure)
        return pid

    def _open_holder(self, pid: int) -> int:
        """Open the process, and verify that it is the holder and not a process that reused its pid."""
        try:
            holder = os.pidfd_open(pid)
        except OSError as error:
            raise StartError(f"the holder of its namespaces cannot be used: {error}") from error
        with contextlib.ExitStack() as undo:
            undo.callback(os.close, holder)
            # In this order: what was read of the pid is of this process if it still runs.
            if not _descends(pid, self.process.pid) or proc.has_ended(holder):
                raise StartError("the holder of its namespaces died")
            undo.pop_all()
        return holder

    def _close(self) -> None:
        _close_all(self._fds)


def _close_all(fds: dict[str, int]) -> None:
    for fd in fds.values():
        os.close(fd)
    fds.clear()


def _descends(pid: int, ancestor: int) -> bool:
    for _ in range(_GENERATIONS):
        process = proc.read(pid)
        if process is None:
            return False
        pid = process.parent
        if pid == ancestor:
            return True
    return False
