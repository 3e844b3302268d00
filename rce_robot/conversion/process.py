"""The event loop's side of a worker process."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import struct
import sys
from typing import TYPE_CHECKING

from rce.buffers import unfilled
from rce_robot.conversion.jobs import HEAD, MAX_PARTS, Job, Result, decode_result, pack
from rce_robot.exceptions import ConversionFailedError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rce_robot.outgoing import Buffer

_START_TIMEOUT_S = 60.0
_MAX_PACKET = 1 << 30


class WorkerProcess:
    """A process that does one job at a time.

    Args:
        packages: Folders with packages that define messages.
        memory: Bytes that it may use.
    """

    def __init__(self, packages: Sequence[Path], memory: int) -> None:
        self._packages = packages
        self._memory = memory
        self._process: asyncio.subprocess.Process | None = None
        self._transport: asyncio.Transport | None = None
        self._reader = _PacketReader()

    @property
    def pid(self) -> int:
        """The pid; 0 before the process exists."""
        return 0 if self._process is None else self._process.pid

    async def start(self) -> None:
        """Start the process and wait until it is ready.

        Raises:
            ConversionFailedError: It does not become ready.
        """
        ours, theirs = socket.socketpair()
        loop = asyncio.get_running_loop()
        with theirs:
            try:
                self._process = await asyncio.create_subprocess_exec(
                    sys.executable,
                    "-P",
                    "-m",
                    "rce_robot.conversion.worker",
                    str(theirs.fileno()),
                    str(self._memory >> 20),
                    *map(str, self._packages),
                    pass_fds=[theirs.fileno()],
                    stdin=asyncio.subprocess.DEVNULL,
                    stdout=asyncio.subprocess.DEVNULL,
                    start_new_session=True,
                    env={key: value for key, value in os.environ.items() if not key.startswith("RCE_SECRET")},
                )
            except BaseException:
                ours.close()
                raise
        ours.setblocking(False)
        transport, _ = await loop.create_connection(lambda: self._reader, sock=ours)
        self._transport = transport
        try:
            async with asyncio.timeout(_START_TIMEOUT_S):
                await self._reader.ready
        except TimeoutError as error:
            raise ConversionFailedError("the process that converts large messages does not start") from error

    async def do(self, job: Job, parts: Sequence[Buffer]) -> tuple[Result, list[memoryview]]:
        """Do a job.

        Raises:
            ConversionFailedError: The process ended.
        """
        assert self._transport is not None
        answer = self._reader.expect()
        self._transport.writelines(pack(job, parts))
        meta, *received = await answer
        return decode_result(meta), received

    async def end(self) -> None:
        """Kill the process and wait until it has ended."""
        if self._transport is not None:
            self._transport.abort()
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()
            await self._process.wait()


class _PacketReader(asyncio.BufferedProtocol):
    """Reads packets directly into memory of their size."""

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        self.ready: asyncio.Future[None] = loop.create_future()
        self._answer: asyncio.Future[list[memoryview]] | None = None
        self._parts: list[memoryview] = []
        self._sizes: list[int] | None = None
        self._begin(1)

    def expect(self) -> asyncio.Future[list[memoryview]]:
        """Wait for the next packet; return its parts."""
        self._answer = asyncio.get_running_loop().create_future()
        if self._lost:
            self._fail()
        return self._answer

    _lost = False

    def get_buffer(self, sizehint: int) -> memoryview:  # noqa: ARG002 - the size is known
        """Return where the next bytes go."""
        return self._view[self._filled :]

    def buffer_updated(self, nbytes: int) -> None:
        """Continue with the next part when one is full."""
        self._filled += nbytes
        while self._filled == len(self._view):
            self._part_received(self._view)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - the reason is not needed
        """Fail the waiting call."""
        self._lost = True
        if not self.ready.done():
            self.ready.set_exception(
                ConversionFailedError("the process that converts large messages does not start")
            )
        self._fail()

    def _fail(self) -> None:
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(
                ConversionFailedError(
                    "the process that converted the message ended; it may need too much memory"
                )
            )

    def _begin(self, size: int) -> None:
        self._view = unfilled(size).getbuffer() if size else memoryview(b"")
        self._filled = 0

    def _part_received(self, part: memoryview) -> None:
        if not self.ready.done():
            self.ready.set_result(None)
            self._begin(HEAD.size)
        elif self._sizes is None:
            (count,) = HEAD.unpack(part)
            if count > MAX_PARTS:
                raise ConversionFailedError(f"a worker answered with {count} parts")
            self._sizes = []
            self._begin(8 * count)
        elif not self._sizes:
            self._sizes = list(struct.unpack(f"!{len(part) // 8}Q", part))
            if sum(self._sizes) > _MAX_PACKET:
                raise ConversionFailedError(f"a worker answered with {sum(self._sizes)} bytes")
            self._begin(self._sizes[0])
        else:
            self._parts.append(part)
            if len(self._parts) < len(self._sizes):
                self._begin(self._sizes[len(self._parts)])
                return
            parts, self._parts, self._sizes = self._parts, [], None
            self._begin(HEAD.size)
            if self._answer is not None and not self._answer.done():
                self._answer.set_result(parts)
