"""Node programs that share a process: each has a command line and environment variables of its own.

A program that makes its node with ``Node("name")`` takes the command line and the variables of its process.
If several programs run in one process, each runs as a :class:`HostedProgram`, whose arguments its node takes
instead::

    program = HostedProgram(["scan:=/front/scan"], {"ROS_MASTER_URI": uri})
    task = program.start(amcl.main())
    program.stop("the launch ends")
"""

from __future__ import annotations

import asyncio
import contextvars
import os
import sys
from collections.abc import Coroutine, Mapping, Sequence
from contextvars import ContextVar
from typing import Any, Protocol

_current: ContextVar[HostedProgram | None] = ContextVar("hosted program", default=None)


class Stoppable(Protocol):
    """A node that can be told to stop."""

    def shutdown(self, reason: str) -> None:
        """Tell it to stop."""


class HostedProgram:
    """A node's program that runs beside others in this process.

    Args:
        argv: Its command line, without the program's name.
        environ: Its environment variables.
    """

    def __init__(self, argv: Sequence[str], environ: Mapping[str, str]) -> None:
        self.argv = tuple(argv)
        self.environ = environ
        self._nodes: list[Stoppable] = []
        self._task: asyncio.Task[Any] | None = None

    def start(self, main: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        """Run a program's coroutine as a task."""
        context = contextvars.copy_context()
        context.run(_current.set, self)
        self._task = asyncio.get_running_loop().create_task(main, context=context)
        return self._task

    def add(self, node: Stoppable) -> None:
        """Note a node that the program made."""
        self._nodes.append(node)

    def stop(self, reason: str) -> None:
        """Tell the program's nodes to stop; cancel it if it has made none yet."""
        for node in self._nodes:
            node.shutdown(reason)
        if not self._nodes:
            self.cancel()

    def cancel(self) -> None:
        """Cancel the program."""
        if self._task is not None:
            self._task.cancel()


def hosted_program() -> HostedProgram | None:
    """Return the program that this code belongs to; None if its process runs only this one."""
    return _current.get()


def program_arguments() -> Sequence[str]:
    """Return the command line of the program that this code belongs to, without the program's name."""
    program = _current.get()
    return sys.argv[1:] if program is None else program.argv


def program_environ() -> Mapping[str, str]:
    """Return the environment variables of the program that this code belongs to."""
    program = _current.get()
    return os.environ if program is None else program.environ
