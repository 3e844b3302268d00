"""One life of a node: a process group, from its start to the end of all processes that it started."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from rce.aio.tasks import BackgroundTasks
from rce.model import NodeSpec
from rce_container.environment.exceptions import NodeError
from rce_container.environment.logs.node_log import NodeLog
from rce_container.environment.logs.pump import Pump
from rce_container.environment.nodes.events import Ended, Event, Made, Refused
from rce_container.environment.nodes.launch import NODE_MARK, Launch, prepare
from rce_container.environment.nodes.reaper import Child, Reaper
from rce_container.environment.process import kill_marked
from rce_container.environment.user_packages import LaunchEnvironment

_PASSING = frozenset({errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE, errno.ETXTBSY, errno.ENOSPC})
"""Errors after which a later start may succeed."""
_LONGEST_FIRST_LINE = 256
"""Bytes that the kernel reads of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeContext:
    """The shared context of a container's nodes."""

    reaper: Reaper
    launch_environment: Callable[[NodeSpec], LaunchEnvironment]
    """Returns the launch environment of a node."""
    mark: str
    home: str
    logs: Path
    interrupt_timeout: float
    terminate_timeout: float
    on_change: Callable[[], None]
    """Called when a node's status has changed."""
    on_fault: Callable[[str], None]
    """A node failed; a text for the user."""
    keep_state: Callable[[NodeSpec, int, Callable[[Event], None]], Coroutine[None, None, None]]
    """Restores and saves the state of a life of a node until cancelled
    (:meth:`rce_container.environment.nodes.states.NodeStates.keep`)."""
    why_killed: Callable[[], Awaitable[str]]
    """Returns why a process ended by a SIGKILL that the environment did not send; empty if unknown."""


class NodeLife:
    """Starts a node's process and waits for its end.

    Args:
        spec: The node.
        life: The life's number.
        context: The context shared by all nodes.
        log: Where its output goes.
        feed: Takes the events of this life.
    """

    def __init__(
        self, spec: NodeSpec, life: int, context: NodeContext, log: NodeLog, feed: Callable[[Event], None]
    ) -> None:
        self.pid = 0
        """The process, which is also its group and its session; 0 while there is none."""
        self.ros_name = ""
        """The global ROS name that it is to take; empty if it chooses its own name."""
        self.life = life
        self._spec = spec
        self._context = context
        self._log = log
        self._feed = feed
        self._halted: asyncio.Future[float] = asyncio.get_running_loop().create_future()

    def halt(self, share: float) -> None:
        """End it by SIGINT, SIGTERM and SIGKILL, with a share of the usual grace times between them."""
        if not self._halted.done():
            self._halted.set_result(share)

    async def run(self) -> None:
        """Run this life. Reports the start when it is known, and the end when no process is left."""
        mark = f"{self._context.mark}.{self._spec.tag}.{self.life}"
        try:
            launch_environment = self._context.launch_environment(self._spec)
            await launch_environment.packages.look_ahead()
            launch = prepare(launch_environment, mark)
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
        if launch.choice:
            self._log.note(launch.choice)
        with ExitStack() as pumps:
            child = self._start(launch, pumps)
            tasks = BackgroundTasks()
            keeping = self._context.keep_state(self._spec, self.life, self._feed)
            tasks.spawn(keeping, name=f"state of {self._spec.tag}")
            try:
                code, reason = await self._watch(child)
            finally:
                await tasks.close()
                child.signal_group(signal.SIGKILL)
                await kill_marked(launch.env[NODE_MARK], variable=NODE_MARK)
        if code and not self._halted.done() and (words := self._log.last_output):
            reason += f"; its last output: {words}"
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
        """Wait until it has ended, by itself or on request; return its exit code and a text about the end."""
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
    """Make a pipe; return the write end, which ``ends`` closes. ``pumps`` closes the read end."""
    reading, writing = os.pipe()
    ends.callback(os.close, writing)
    pumps.callback(Pump(reading, take).close)
    return writing


def describe_exit(code: int) -> str:
    """Describe how a process ended."""
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
    """Return the interpreter that a script's first line names; empty if it names none."""
    try:
        with Path(script).open("rb") as file:
            line = file.readline(_LONGEST_FIRST_LINE)
    except OSError:
        return ""
    return line[2:].strip().decode(errors="replace") if line.startswith(b"#!") else ""
