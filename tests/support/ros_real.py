"""A real ROS 1 beside ours: its tools and nodes as processes, at our core or at its own."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any, TypeVar

from rce.ros.core import Core
from rce.ros.errors import XmlRpcError
from rce.ros.xmlrpc import RpcClient
from support.ports import free_port
from support.processes import finish

TIMEOUT_S = 120.0
"""Seconds that a program of a real ROS may take: some start slowly."""


def ros_environment(uri: str, home: Path) -> dict[str, str]:
    """What programs of a real ROS need; without this project's Python."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTHON", "VIRTUAL_ENV", "ROS_", "RCE_"))
    }
    return kept | {
        "ROS_MASTER_URI": uri,
        "ROS_IP": "127.0.0.1",
        "ROS_PACKAGE_PATH": f"{home}:/usr/share",
        "PATH": "/usr/bin:/bin",
        "HOME": str(home),
        "PYTHONUNBUFFERED": "1",
    }


T = TypeVar("T")


class Graph:
    """A ROS graph with a core of either kind."""

    def __init__(self, uri: str, home: Path, kind: str) -> None:
        self.uri = uri
        self.kind = kind
        self.home = home
        self.env = ros_environment(uri, home)

    async def tool(self, *argv: str, check: bool = True, stdin: str = "") -> str:
        """Run a command line tool to its end; return what it prints."""
        process = await asyncio.create_subprocess_exec(
            *argv,
            env=self.env,
            cwd=self.home,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            async with asyncio.timeout(TIMEOUT_S):
                output, _ = await process.communicate(stdin.encode())
        finally:
            await finish(process)
        text = output.decode(errors="replace")
        assert not check or process.returncode == 0, f"{' '.join(argv)}: {text}"
        return text

    @contextlib.asynccontextmanager
    async def program(self, *argv: str, node: str = "") -> AsyncIterator[asyncio.subprocess.Process]:
        """Run a program until the block ends; with ``node``, wait until a node of this name is there."""
        process = await asyncio.create_subprocess_exec(
            *argv, env=self.env, cwd=self.home, stdin=asyncio.subprocess.DEVNULL, start_new_session=True
        )
        try:
            if node:
                await self.until(lambda: self.node(node), what=f"{node} is registered")
            yield process
        finally:
            await interrupt(process)

    async def says(self, *argv: str, text: str, count: int = 1) -> str:
        """Run a program until it has printed ``text`` so many times; return what it printed."""
        process = await asyncio.create_subprocess_exec(
            *argv,
            env=self.env,
            cwd=self.home,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
        )
        assert process.stdout is not None
        printed = ""
        try:
            async with asyncio.timeout(TIMEOUT_S):
                while printed.count(text) < count:
                    line = await process.stdout.readline()
                    assert line, f"{argv} ended and printed {printed!r}"
                    printed += line.decode(errors="replace")
        except TimeoutError:
            raise AssertionError(f"{argv} has not said {text!r} in {TIMEOUT_S:g} s: {printed!r}") from None
        finally:
            await finish(process)
        return printed

    async def ask(self, method: str, *arguments: object) -> Any:
        """Call the master; None if it does not answer or refuses."""
        async with RpcClient() as rpc:
            try:
                status, _, value = await rpc.call(self.uri, method, ("/test", *arguments))
            except XmlRpcError:
                return None
        return value if status == 1 else None

    async def node(self, name: str) -> str | None:
        """The slave API of a node."""
        found: str | None = await self.ask("lookupNode", name)
        return found

    async def service(self, name: str) -> str | None:
        """The URI of a service."""
        found: str | None = await self.ask("lookupService", name)
        return found

    async def publishers(self, topic: str) -> list[str]:
        """The nodes that publish a topic."""
        state = await self.ask("getSystemState") or [[], [], []]
        return next((nodes for name, nodes in state[0] if name == topic), [])

    async def until(self, condition: Callable[[], Awaitable[T | None]], *, what: str) -> T:
        """Wait until ``condition`` gives something true."""
        try:
            async with asyncio.timeout(TIMEOUT_S):
                while not (found := await condition()):
                    await asyncio.sleep(0.05)
        except TimeoutError:
            raise AssertionError(f"{what}: not within {TIMEOUT_S:g} s") from None
        return found


async def interrupt(process: asyncio.subprocess.Process) -> None:
    """End a program as Ctrl-C does; some of a real ROS's do not always end by that, and are killed."""
    with contextlib.suppress(TimeoutError):
        await finish(process, signal.SIGINT, timeout=20)


@contextlib.asynccontextmanager
async def our_graph(home: Path, port: int = 0) -> AsyncIterator[Graph]:
    """A graph with a core of ours, in this process."""
    async with Core(port=port, rosout=True) as core:
        yield Graph(core.uri, home, "ours")
        core.graph.validate()


@contextlib.asynccontextmanager
async def real_graph(home: Path, port: int = 0) -> AsyncIterator[Graph]:
    """A graph with a real ``roscore``."""
    port = port or free_port()
    graph = Graph(f"http://127.0.0.1:{port}/", home, "roscore")
    async with graph.program("/usr/bin/roscore", "-p", str(port), node="/rosout"):
        await graph.until(lambda: graph.ask("getParam", "/run_id"), what="roscore is up")
        yield graph


GRAPHS = {"ours": our_graph, "roscore": real_graph}
