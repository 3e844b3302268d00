"""Runs the nodes of a launch plan until they have ended, one that is required ends, or it is told to stop."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rce.ros.errors import PackageError
from rce.ros.launch.exceptions import LaunchError
from rce.ros.launch.plan import LaunchPlan, NodePlan, Output
from rce.ros.launching.command import node_command
from rce.ros.launching.graph import LaunchGraph, launch_graph, wait_for_master
from rce.ros.launching.hosted import HostedNode, can_host
from rce.ros.launching.launched import LaunchedNode, StopTimeouts, describe_end, describe_failure
from rce.ros.launching.process import NodeProcess
from rce.ros.names import segments

if TYPE_CHECKING:
    from rce.ros.packages import PackageIndex


class Launcher:
    """Carries out a launch plan.

    Args:
        plan: The plan.
        packages: Where packages are looked for.
        master_uri: The master, which is started if it does not answer and its address is this machine's.
        log_folder: Where the logs of runs are, each in a folder of its own; None: no logs.
        environ: Environment variables of the nodes.
        report: Takes lines for the user.
        timeouts: How long a node may take to end.
        waits: Wait for the master instead of starting it.
        shows_all: Show the output of all nodes, also of those that ask for a file.
        one_process: Run the nodes that Python distributions add in this process.

    Example:
        >>> launcher = Launcher(plan, PackageIndex.of_machine(), "http://127.0.0.1:11311/", None)
        >>> asyncio.run(launcher.run())
        0
    """

    def __init__(
        self,
        plan: LaunchPlan,
        packages: PackageIndex,
        master_uri: str,
        log_folder: Path | None,
        *,
        environ: Mapping[str, str] = os.environ,
        report: Callable[[str], None] = print,
        timeouts: StopTimeouts = StopTimeouts(),  # noqa: B008 - a value
        waits: bool = False,
        shows_all: bool = False,
        one_process: bool = False,
    ) -> None:
        self._plan = plan
        self._packages = packages
        self._master_uri = master_uri
        self._log_folder = log_folder
        self._environ = environ
        self._report = report
        self._timeouts = timeouts
        self._waits = waits
        self._shows_all = shows_all
        self._one_process = one_process
        self._nodes: list[LaunchedNode] = []
        self._is_told = asyncio.Event()
        self._failures = 0

    def stop(self) -> None:
        """End all nodes, then the master if it was started here; a second call does not wait for them."""
        for node in self._nodes if self._is_told.is_set() else ():
            node.hurry()
        self._is_told.set()

    async def run(self) -> int:
        """Carry out the plan. Cancelling this kills all nodes.

        Returns:
            The exit code: 0, or 1 if a node could not be started, or a required one failed.

        Raises:
            LaunchError: There is no master, or parameters cannot be set.
        """
        if self._waits:
            await wait_for_master(self._master_uri, self._is_told)
        if self._is_told.is_set():
            return 0
        async with launch_graph(self._master_uri, self._log_folder) as graph:
            await self._run(graph)
        return 1 if self._failures else 0

    async def _run(self, graph: LaunchGraph) -> None:
        self._report(f"ROS_MASTER_URI={graph.uri}" + (" (started here)" if graph.is_own else ""))
        folder = await self._make_folder(graph)
        await graph.apply(self._plan)
        if self._is_told.is_set():
            return
        for number, plan in enumerate(self._plan.nodes, 1):
            prepared = self._prepare(plan, number, graph, folder)
            if prepared is not None:
                self._nodes.append(prepared)
            elif plan.required:
                self._report(f"{plan.name} is required: no node is started")
                return
        async with asyncio.TaskGroup() as group:
            stopping = group.create_task(self._stop_all_when_told())
            nodes = [group.create_task(self._run_node(node)) for node in self._nodes]
            for task in nodes:
                await task
            stopping.cancel()
        if not self._is_told.is_set():
            self._report("all nodes have ended")

    async def _make_folder(self, graph: LaunchGraph) -> Path | None:
        run_id = await graph.run_id()
        if self._log_folder is None:
            return None
        folder = self._log_folder / run_id
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise LaunchError(f"the folder for logs cannot be made: {folder}: {error.strerror}") from error
        self._report(f"logs are in {folder}")
        return folder

    def _prepare(
        self, node: NodePlan, number: int, graph: LaunchGraph, folder: Path | None
    ) -> LaunchedNode | None:
        label = "-".join(segments(node.name)) + f"-{number}"
        log = folder / f"{label}.log" if folder is not None else None
        output = None
        if folder is not None and node.output is Output.LOG and not self._shows_all:
            output = folder / f"{label}-stdout.log"
        try:
            command = node_command(node, self._packages, self._environ, graph.uri, log)
        except PackageError as error:
            self._fail(node, str(error))
            return None
        if command.choice:
            self._report(f"{node.name}: {command.choice}")
        if self._one_process and can_host(node, command):
            return HostedNode(node, command, self._report, self._timeouts)
        return NodeProcess(node, command, output, self._report, self._timeouts)

    async def _run_node(self, launched: LaunchedNode) -> None:
        node = launched.plan
        try:
            code = await launched.run()
        except OSError as error:
            self._fail(node, describe_failure(error))
            code = 1
        if node.required and not self._is_told.is_set():
            self._failures += bool(code)
            self._report(f"{node.name} is required and {describe_end(code)}: all others are ended")
            self._is_told.set()

    async def _stop_all_when_told(self) -> None:
        await self._is_told.wait()
        for node in self._nodes:
            node.stop()

    def _fail(self, node: NodePlan, reason: str) -> None:
        self._failures += 1
        self._report(f"{node.place}: {node.name} ({node.package}/{node.type}): {reason}")
