"""A child program under supervision: started, read line by line, ended by escalation."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import AsyncIterator, Mapping, Sequence
from functools import partial
from typing import Final, Protocol

_PR_SET_PDEATHSIG: Final = 1
_libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None

STOP_TIMEOUT_S = 60.0
"""Longer than ``rce-container`` takes for containers with nodes that do not end when they are told."""
KILL_TIMEOUT_S = 5.0
MAX_LINE = 1 << 20
VARIABLES: Final = {"PYTHONUNBUFFERED": "1"}
"""Environment variables of all children, beside this program's own."""


def end_with(parent: int) -> None:
    """Run in a child: ask the kernel for a SIGTERM when the supervisor dies, however it dies."""
    if _libc is not None:
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:  # it died before it was asked
            os.kill(os.getpid(), signal.SIGTERM)


class Process(Protocol):
    """A process of this one's, as :class:`asyncio.subprocess.Process` shows it."""

    @property
    def pid(self) -> int:
        """The process id."""

    @property
    def returncode(self) -> int | None:
        """The exit code, or None while it runs."""

    @property
    def stdout(self) -> asyncio.StreamReader | None:
        """Its output."""

    async def wait(self) -> int:
        """Wait for its end; return the exit code."""


class Child:
    """A running program. Its output is read by :meth:`lines`; it ends with its supervisor."""

    def __init__(self, name: str, process: Process) -> None:
        self.name = name
        self._process = process

    @classmethod
    async def start(cls, name: str, argv: Sequence[str], *, env: Mapping[str, str] | None = None) -> Child:
        """Start a program in its own session, so that a Ctrl-C at the terminal reaches the supervisor only.

        Raises:
            OSError: It cannot be started.
        """
        process = await asyncio.create_subprocess_exec(
            *argv,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env={**os.environ, **VARIABLES, **(env or {})},
            start_new_session=True,
            preexec_fn=partial(end_with, os.getpid()),
            limit=MAX_LINE,
        )
        return cls(name, process)

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """The exit code, or None while it runs."""
        return self._process.returncode

    async def lines(self) -> AsyncIterator[str]:
        """Yield the lines of the program's output, until it closes the output."""
        assert self._process.stdout is not None
        while True:
            try:
                line = await self._process.stdout.readline()
            except ValueError:
                yield f"(a line longer than {MAX_LINE} bytes was left out)"
                continue
            if not line:
                return
            yield line.decode(errors="replace").rstrip("\n")

    async def wait(self) -> int:
        """Wait for its end; returns the exit code."""
        return await self._process.wait()

    async def stop(self, *, timeout: float = STOP_TIMEOUT_S) -> None:
        """End it: SIGTERM, and SIGKILL for its whole group after ``timeout`` seconds."""
        if self.returncode is None:
            self._signal(signal.SIGTERM)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(timeout):
                    await self.wait()
        if self.returncode is None:
            self._signal(signal.SIGKILL)
            async with asyncio.timeout(KILL_TIMEOUT_S):
                await self.wait()

    def hurry(self) -> None:
        """Send SIGTERM once more, which programs take as a request not to wait for others."""
        if self.returncode is None:
            self._signal(signal.SIGTERM)

    def _signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, number)
