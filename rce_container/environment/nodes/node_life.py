"""One life of a node: a process group, from its start to the end of all that it started."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from rce.model.specs import NodeSpec
from rce_container.environment.exceptions import NodeError
from rce_container.environment.logs.node_log import NodeLog
from rce_container.environment.logs.pump import Pump
from rce_container.environment.nodes.events import Ended, Event, Made, Refused
from rce_container.environment.nodes.launch import NODE_MARK, Launch, prepare
from rce_container.environment.nodes.reaper import Child, Reaper
from rce_container.environment.process import kill_marked
from rce_container.environment.user_packages import LaunchEnvironment

_PASSING = frozenset({errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE, errno.ETXTBSY, errno.ENOSPC})
"""Errors for which a start may succeed when it is tried later."""
_LONGEST_FIRST_LINE = 256
"""Bytes that the kernel reads of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeContext:
    """What nodes are made with."""

    reaper: Reaper
    launch_environment: Callable[[NodeSpec], LaunchEnvironment]
    """Says what a node is started with."""
    mark: str
    home: str
    logs: Path
    interrupt_timeout: float
    terminate_timeout: float
    on_change: Callable[[], None]
    """Some node's status is another one."""
    on_fault: Callable[[str], None]
    """A node failed; a text for the user."""
    why_killed: Callable[[], Awaitable[str]]
    """Says why a process ended by SIGKILL just now that nobody here sent; empty if nobody knows."""


class NodeLife:
    """Starts a node's process and waits for its end.

    Args:
        spec: The node.
        life: The life's number.
        context: What it is made with.
        log: Where its output goes.
        feed: Takes what happens.
    """

    def __init__(
        self, spec: NodeSpec, life: int, context: NodeContext, log: NodeLog, feed: Callable[[Event], None]
    ) -> None:
        self.pid = 0
        """The process, which is also its group and its session; 0 while there is none."""
        self.ros_name = ""
        """The global ROS name that it was told to take; empty if it chooses by itself."""
        self.life = life
        self._spec = spec
        self._context = context
        self._log = log
        self._feed = feed
        self._halted: asyncio.Future[float] = asyncio.get_running_loop().create_future()

    def halt(self, share: float) -> None:
        """Have it ended by SIGINT, SIGTERM and SIGKILL, with a share of the usual pauses between them."""
        if not self._halted.done():
            self._halted.set_result(share)

    async def run(self) -> None:
        """Live. Tells of the beginning when it is known, and of the end when nothing is left."""
        mark = f"{self._context.mark}.{self._spec.tag}.{self.life}"
        try:
            launch = prepare(self._context.launch_environment(self._spec), mark)
            event = await self._live(launch)
        except NodeError as error:
            event = Refused(self._spec.tag, self.life, str(error), hopeless=True)
        except OSError as error:
            hopeless = error.errno not in _PASSING
            event = Refused(self._spec.tag, self.life, _in_words(error), hopeless=hopeless)
        self.pid = 0
        self._feed(event)

    async def _live(self, launch: Launch) -> Event:
        self._log.begin()
        with ExitStack() as pumps:
            child = self._start(launch, pumps)
            try:
                code, reason = await self._watch(child)
            finally:
                child.signal_group(signal.SIGKILL)
                await kill_marked(launch.env[NODE_MARK], variable=NODE_MARK)
        if code and not self._halted.done() and (words := self._log.last_words):
            reason += f"; its last words: {words}"
        return Ended(self._spec.tag, self.life, code, reason)

    def _start(self, launch: Launch, pumps: ExitStack) -> Child:
        with ExitStack() as ends:
            stdout = _pipe(self._log.stdout, pumps, ends)
            stderr = _pipe(self._log.stderr, pumps, ends)
            child = self._context.reaper.spawn(
                launch.argv, env=launch.env, cwd=self._context.home, stdout=stdout, stderr=stderr
            )
        self.pid, self.ros_name = child.pid, launch.ros_name
        self._feed(Made(self._spec.tag, self.life, child.pid))
        return child

    async def _watch(self, child: Child) -> tuple[int, str]:
        """Wait until it ended, by itself or because it is to; returns its exit code and the end in words."""
        await asyncio.wait((child.ended, self._halted), return_when=asyncio.FIRST_COMPLETED)
        if not child.ended.done():
            return await self._escalate(child, self._halted.result())
        code = child.ended.result()
        cause = await self._context.why_killed() if code == -signal.SIGKILL else ""
        return code, cause or describe_exit(code)

    async def _escalate(self, child: Child, share: float) -> tuple[int, str]:
        for number, timeout in (
            (signal.SIGINT, self._context.interrupt_timeout),
            (signal.SIGTERM, self._context.terminate_timeout),
        ):
            child.signal_group(number)
            done, _ = await asyncio.wait((child.ended,), timeout=timeout * share)
            if done:
                return child.ended.result(), f"it was told to by {number.name}"
        child.signal_group(signal.SIGKILL)
        return await child.ended, "killed, because it did not end on SIGINT and SIGTERM"


def _pipe(take: Callable[[bytes], None], pumps: ExitStack, ends: ExitStack) -> int:
    """Make a pipe; returns the end to write to, which ``ends`` closes, as ``pumps`` do the other."""
    reading, writing = os.pipe()
    ends.callback(os.close, writing)
    pumps.callback(Pump(reading, take).close)
    return writing


def describe_exit(code: int) -> str:
    """Say in words how a process ended."""
    if code >= 0:
        return f"exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"killed by {name}" + (" (by hand, or out of memory)" if code == -signal.SIGKILL else "")


def _in_words(error: OSError) -> str:
    text = error.strerror or str(error)
    if not error.filename:
        return text
    if error.errno == errno.ENOENT and (interpreter := _interpreter(error.filename)):
        text = f"the interpreter {interpreter} of its first line does not exist here"
    elif error.errno == errno.ENOEXEC:
        text += "; if it is a script, its first line must name its interpreter, as in #!/usr/bin/env python3"
    return f"{error.filename}: {text}"


def _interpreter(script: str) -> str:
    """What the first line of a script names; empty if there is none."""
    try:
        with Path(script).open("rb") as file:
            line = file.readline(_LONGEST_FIRST_LINE)
    except OSError:
        return ""
    return line[2:].strip().decode(errors="replace") if line.startswith(b"#!") else ""
