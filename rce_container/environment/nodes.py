"""The nodes of a container: each is a process group with a log and one task that owns it."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

from rce.control.model import NodeSpec, NodeState, NodeStatus
from rce.ros.packages import PackageIndex
from rce_container.environment.exceptions import NodeError
from rce_container.environment.launch import NODE_MARK, Launch, prepare
from rce_container.environment.logs import LogWriter, Pump
from rce_container.environment.process import strike_all
from rce_container.environment.reaper import Child, Reaper

_LAST_LINE_LENGTH = 300
_REGISTERS_WITHIN_S = 10.0
"""A node that did not register with the ROS core for so long probably never will."""
_SETTLES_WITHIN_S = 0.5
"""After a node's first registration its others follow within this time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Workshop:
    """What nodes are made with."""

    reaper: Reaper
    packages: PackageIndex
    environ: Mapping[str, str]
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
    lives: Iterable[int] = field(default_factory=count)


class NodeSet:
    """All nodes of a container, made like the desired ones.

    Args:
        workshop: What nodes are made with.
        tasks: Where the nodes' owner tasks run.
    """

    def __init__(self, workshop: Workshop, tasks: asyncio.TaskGroup) -> None:
        self._workshop = workshop
        self._tasks = tasks
        self._nodes: dict[str, _Node] = {}

    def apply(self, specs: Iterable[NodeSpec]) -> None:
        """Start nodes that are missing, stop those that are too many, restart those that changed."""
        desired = {spec.tag: spec for spec in specs}
        for tag, node in self._nodes.items():
            if node.desired != desired.get(tag):
                node.desire(desired.get(tag))
        for tag, spec in desired.items():
            if tag not in self._nodes:
                node = self._nodes[tag] = _Node(spec, self._workshop)
                self._tasks.create_task(self._own(tag, node), name=f"node {tag}")
        self._workshop.on_change()

    @property
    def statuses(self) -> tuple[NodeStatus, ...]:
        """What there is to report, by tag."""
        return tuple(self._nodes[tag].status for tag in sorted(self._nodes))

    @property
    def settling(self) -> bool:
        """Whether a node has yet to take up its topics and services: it started or registered just now."""
        now = asyncio.get_running_loop().time()
        return any(now < node.settled_at for node in self._nodes.values())

    def registered(self, ros_name: str) -> bool:
        """Note that a node of this global ROS name registered; whether one was told to take that name."""
        node = next((node for node in self._nodes.values() if ros_name and node.ros_name == ros_name), None)
        if node is not None:
            node.note_registered()
        return node is not None

    def registered_process(self, pid: int) -> bool:
        """Note that a process registered with the ROS core; whether it belongs to one of the nodes."""
        try:
            session = os.getsid(pid)
        except OSError:
            return False
        node = next((node for node in self._nodes.values() if node.status.pid == session), None)
        if node is not None:
            node.note_registered()
        return node is not None

    async def close(self) -> None:
        """Stop all nodes, each by escalation, all at once."""
        self.apply(())
        await asyncio.gather(*(node.gone.wait() for node in self._nodes.values()))

    async def _own(self, tag: str, node: _Node) -> None:
        try:
            await node.run()
        finally:
            del self._nodes[tag]
            node.gone.set()
            self._workshop.on_change()


class _Node:
    """One node through all its lives: a changed node is stopped and started anew."""

    def __init__(self, spec: NodeSpec, workshop: Workshop) -> None:
        self.desired: NodeSpec | None = spec
        self.status = NodeStatus(tag=spec.tag, state=NodeState.STARTING)
        self.ros_name = ""
        self.settled_at = 0.0
        """When the node is taken to have all its topics and services, by the event loop's clock."""
        self.gone = asyncio.Event()
        self._tag = spec.tag
        self._workshop = workshop
        self._changed: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def desire(self, spec: NodeSpec | None) -> None:
        self.desired = spec
        if not self._changed.done():
            self._changed.set_result(None)

    def note_registered(self) -> None:
        if self.status.state is NodeState.STARTING and self.status.pid:
            self.settled_at = asyncio.get_running_loop().time() + _SETTLES_WITHIN_S
            self._become(NodeState.RUNNING, pid=self.status.pid)

    async def run(self) -> None:
        """Live until no life is desired any more."""
        while (spec := self.desired) is not None:
            self._changed = asyncio.get_running_loop().create_future()
            self._become(NodeState.STARTING)
            mark = f"{self._workshop.mark}.{self._tag}.{next(iter(self._workshop.lives))}"
            try:
                await self._live(prepare(spec, self._workshop.packages, self._workshop.environ, mark))
            except (NodeError, OSError) as error:
                self._fail(f"node {self._tag} cannot be started: {error}", detail=str(error))
            await self._changed

    async def _live(self, launch: Launch) -> None:
        log = LogWriter(self._workshop.logs, self._tag)
        try:
            reading, writing = os.pipe()
            pump = Pump(reading, log)
            try:
                child = self._start(launch, writing)
                try:
                    code = await self._watch(child)
                finally:
                    child.signal_group(signal.SIGKILL)
                    await strike_all(launch.env[NODE_MARK], variable=NODE_MARK)
            finally:
                pump.close()
            self.settled_at = 0.0
            await self._note_end(code, log.last_line)
        finally:
            log.close()

    def _start(self, launch: Launch, output: int) -> Child:
        try:
            child = self._workshop.reaper.spawn(
                launch.argv, env=launch.env, cwd=self._workshop.home, output=output
            )
        except OSError as error:
            raise NodeError(f"{launch.argv[0]}: {error.strerror or error}") from error
        finally:
            os.close(output)
        self.ros_name = launch.ros_name
        self.settled_at = asyncio.get_running_loop().time() + _REGISTERS_WITHIN_S
        self._become(NodeState.STARTING, pid=child.pid)
        return child

    async def _watch(self, child: Child) -> int:
        """Wait until the node ended, by itself or because another life is desired; returns its exit code."""
        await asyncio.wait((child.ended, self._changed), return_when=asyncio.FIRST_COMPLETED)
        if not child.ended.done():
            self._become(NodeState.STOPPING, pid=child.pid)
            for number, patience in (
                (signal.SIGINT, self._workshop.interrupt_timeout),
                (signal.SIGTERM, self._workshop.terminate_timeout),
            ):
                child.signal_group(number)
                done, _ = await asyncio.wait((child.ended,), timeout=patience)
                if done:
                    break
            child.signal_group(signal.SIGKILL)
        return await child.ended

    async def _note_end(self, code: int, last_line: str) -> None:
        if self.status.state is NodeState.STOPPING:
            return
        if code == 0:
            self._become(NodeState.EXITED, exit_code=0, detail="ended by itself")
            return
        cause = await self._workshop.why_killed() if code == -signal.SIGKILL else ""
        reason = cause or describe_exit(code)
        if last_line:
            reason += f"; its last words: {last_line[:_LAST_LINE_LENGTH]}"
        self._fail(f"node {self._tag} failed: {reason}", exit_code=code, detail=reason)

    def _fail(self, text: str, *, exit_code: int | None = None, detail: str) -> None:
        self._become(NodeState.FAILED, exit_code=exit_code, detail=detail)
        self._workshop.on_fault(text)

    def _become(
        self, state: NodeState, *, pid: int = 0, exit_code: int | None = None, detail: str = ""
    ) -> None:
        self.status = NodeStatus(tag=self._tag, state=state, pid=pid, exit_code=exit_code, detail=detail)
        self._workshop.on_change()


def describe_exit(code: int) -> str:
    """Say in words how a process ended."""
    if code >= 0:
        return f"exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"killed by {name}" + (" (by hand, or out of memory)" if code == -signal.SIGKILL else "")
