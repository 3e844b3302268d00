"""The nodes of a container: carries out the decisions of :mod:`rce_container.environment.nodes.core`."""

from __future__ import annotations

import asyncio
import math
import os
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import assert_never

from rce.control import NodeStatus
from rce.model import NodeSpec
from rce_container.environment.logs.files import remove_log
from rce_container.environment.logs.node_log import NodeLog
from rce_container.environment.nodes import events as e
from rce_container.environment.nodes.core import NodesCore
from rce_container.environment.nodes.node_life import NodeContext, NodeLife

MAX_DEPARTED = 50
"""How many logs of removed nodes are kept while their container runs."""


class NodeSet:
    """All nodes of a container, kept as desired.

    Args:
        context: The shared context of all nodes.
        tasks: Where the nodes' lives run.
    """

    def __init__(self, context: NodeContext, tasks: asyncio.TaskGroup) -> None:
        self._context = context
        self._tasks = tasks
        self._loop = asyncio.get_running_loop()
        self._core = NodesCore()
        self._lives: dict[str, NodeLife] = {}
        """The newest life of each node, by tag."""
        self._logs: dict[str, NodeLog] = {}
        self._departed: deque[str] = deque()
        """Removed nodes whose logs are kept."""
        self._ros_names: dict[str, str] = {}
        """Tags by the names under which nodes registered with the ROS core."""
        self._timer: asyncio.TimerHandle | None = None
        self._empty = asyncio.Event()
        self._empty.set()

    def apply(self, specs: Iterable[NodeSpec]) -> None:
        """Start missing nodes, stop undesired ones and restart changed ones."""
        self._feed(e.Desire(tuple(specs)))

    def lack(self, texts: Mapping[str, str]) -> None:
        """Hold back exactly the nodes that cannot start yet; release all others.

        Args:
            texts: The reason as text, by tag.
        """
        self._feed(e.Lack(texts))

    @property
    def statuses(self) -> tuple[NodeStatus, ...]:
        """Return the nodes' statuses, by tag."""
        return self._core.statuses

    @property
    def is_degraded(self) -> bool:
        """Whether a node failed, is stuck, or pauses after a failure."""
        return self._core.is_degraded

    @property
    def is_settling(self) -> bool:
        """Whether a node has yet to register its topics and services, and is likely to do so soon."""
        return self._core.is_settling(self._loop.time())

    def registered(self, ros_name: str) -> bool:
        """Note that a global ROS name registered; return whether a node was to take that name."""
        return self._note_registered(ros_name, lambda life: life.ros_name == ros_name)

    def registered_process(self, ros_name: str, pid: int) -> bool:
        """Note that a process registered with the ROS core; return whether it belongs to one of the nodes."""
        try:
            session = os.getsid(pid)
        except OSError:
            return False
        return self._note_registered(ros_name, lambda life: life.pid == session)

    def beat(self, tag: str) -> None:
        """Note a message on a node's heartbeat topic."""
        self._feed(e.Beat(tag))

    def log_of(self, ros_name: str) -> NodeLog | None:
        """Return the log of the node that registered under a name in ROS; None if no node did."""
        return self._logs.get(self._ros_names.get(ros_name, ""))

    async def close(self) -> None:
        """Stop all nodes, each by escalation, in the reverse of their start order."""
        self.apply(())
        await self._empty.wait()
        if self._timer is not None:
            self._timer.cancel()

    def _note_registered(self, ros_name: str, is_it: Callable[[NodeLife], bool]) -> bool:
        for tag, life in self._lives.items():
            if life.pid and is_it(life):
                self._ros_names[ros_name] = tag
                self._feed(e.Registered(tag, life.life))
                return True
        return False

    def _feed(self, event: e.Event) -> None:
        instructions = self._core.handle(event, self._loop.time())
        for instruction in instructions:
            self._perform(instruction)
        self._set_timer()
        if instructions or not isinstance(event, e.Beat):
            self._context.on_change()

    def _perform(self, instruction: e.Instruction) -> None:
        match instruction:
            case e.Launch(tag=tag, life=number, spec=spec):
                self._empty.clear()
                self._launch(tag, number, spec)
            case e.Halt(tag=tag, life=number, share=share):
                life = self._lives.get(tag)
                if life is not None and life.life == number:  # else it is just being refused
                    life.halt(share)
            case e.Note(tag=tag, text=text):
                if tag in self._logs:
                    self._logs[tag].note(text)
            case e.Tell(text=text):
                self._context.on_fault(text)
            case e.Forget(tag=tag):
                self._forget(tag)
            case _:
                assert_never(instruction)

    def _launch(self, tag: str, number: int, spec: NodeSpec) -> None:
        try:
            log = self._logs.get(tag) or NodeLog(self._context.logs, tag)
        except OSError as error:
            text = f"its log cannot be opened: {error.strerror}"
            self._loop.call_soon(self._feed, e.Refused(tag, number, text, hopeless=False))
            return
        self._logs[tag] = log
        life = self._lives[tag] = NodeLife(spec, number, self._context, log, self._feed)
        self._tasks.create_task(life.run(), name=f"node {tag}")

    def _forget(self, tag: str) -> None:
        log = self._logs.pop(tag, None)
        if log is not None:
            log.close()
            self._departed.append(tag)
        while len(self._departed) > MAX_DEPARTED:
            oldest = self._departed.popleft()
            if oldest not in self._logs and oldest not in self._departed:
                remove_log(self._context.logs, oldest)
        self._lives.pop(tag, None)
        self._ros_names = {name: owner for name, owner in self._ros_names.items() if owner != tag}
        if not self._core.statuses:
            self._empty.set()

    def _set_timer(self) -> None:
        deadline = self._core.deadline
        if self._timer is not None:
            if not self._timer.cancelled() and self._timer.when() <= deadline:
                return  # at worst the timer fires too early, and is set again
            self._timer.cancel()
        self._timer = self._loop.call_at(deadline, self._tick) if deadline < math.inf else None

    def _tick(self) -> None:
        self._timer = None
        self._feed(e.Tick())
