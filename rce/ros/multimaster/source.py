"""Sources of a master's registrations: XML-RPC, or a core in the same process."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

from rce.ros.core import Core, GraphWatch
from rce.ros.errors import MasterUnreachableError, XmlRpcError
from rce.ros.multimaster.state import Names, read_names
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc.dispatch import SUCCESS

SETTLE = 0.05
"""Seconds in which changes of a watched core are gathered."""

RUN_ID = "/run_id"
"""Parameter to which each run of ``roscore`` or a core gives another value; a bare ``rosmaster`` has none."""

MAX_CALLS = 2000
"""How many calls go into one ``system.multicall``."""


Run = tuple[int, str]
"""Identifies a process of a master: its number, which in a container may always be the same, and its run."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """All registrations of a master at one time."""

    publishers: Names = field(default_factory=dict)
    subscribers: Names = field(default_factory=dict)
    services: Names = field(default_factory=dict)
    topic_types: Mapping[str, str] = field(default_factory=dict)
    node_uris: Mapping[str, str] = field(default_factory=dict)
    service_uris: Mapping[str, str] = field(default_factory=dict)
    run: Run = (0, "")
    """The master's process: another one means that the master was restarted."""


class MasterSource(Protocol):
    """Reads the registrations of a master."""

    async def read(self) -> Snapshot:
        """Read everything.

        Raises:
            MasterError: The master does not answer as it should.
        """

    async def wait(self, longest: float) -> None:
        """Wait until something may have changed, at most ``longest`` seconds."""


class RpcSource:
    """Asks a master over XML-RPC, in four calls however large the graph is."""

    def __init__(self, master: MasterClient) -> None:
        self._master = master

    async def read(self) -> Snapshot:
        """Read everything.

        Raises:
            MasterError: The master does not answer as it should.
        """
        state, types, *run = await self._many([("getSystemState",), ("getTopicTypes",), *_ASK_RUN])
        try:
            publishers, subscribers, services = (read_names(part) for part in state)
            topic_types = {
                topic: kind for topic, kind in types if isinstance(topic, str) and isinstance(kind, str)
            }
        except (TypeError, ValueError) as error:
            raise MasterUnreachableError(self._master.uri, "its state has no known form") from error
        nodes = sorted(
            {
                node
                for names in (publishers, subscribers, services)
                for entry in names.values()
                for node in entry
            }
        )
        node_uris = await self._many([("lookupNode", node) for node in nodes])
        service_uris = await self._many([("lookupService", service) for service in services])
        return Snapshot(
            publishers,
            subscribers,
            services,
            topic_types,
            _known(nodes, node_uris),
            _known(list(services), service_uris),
            _run(*run),
        )

    async def wait(self, longest: float) -> None:
        """Wait ``longest`` seconds: a master does not announce changes."""
        await asyncio.sleep(longest)

    async def _many(self, calls: Sequence[tuple[str, ...]]) -> list[Any]:
        return await multicall(self._master, calls)


async def ask_run(master: MasterClient) -> Run:
    """Ask which process the master is.

    Raises:
        MasterUnreachableError: The master does not answer as it should.
    """
    return _run(*await multicall(master, _ASK_RUN))


async def multicall(master: MasterClient, calls: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Make many calls of a master at once.

    Args:
        master: The master.
        calls: For each, the method and its arguments without the caller's name.

    Returns:
        The value of each answer; None for a call that the master refused.

    Raises:
        MasterUnreachableError: The master does not answer as it should.
    """
    values: list[Any] = []
    for begin in range(0, len(calls), MAX_CALLS):
        part = [
            {"methodName": method, "params": [master.caller, *arguments]}
            for method, *arguments in calls[begin : begin + MAX_CALLS]
        ]
        values += await _multicall(master, part)
    return values


async def multicall_as(master: MasterClient, calls: Sequence[tuple[str, str, tuple[Any, ...]]]) -> list[Any]:
    """Make many calls in the names of other nodes: ``(method, node, arguments)`` each.

    Returns and raises as :func:`multicall` does.
    """
    values: list[Any] = []
    for begin in range(0, len(calls), MAX_CALLS):
        part = [
            {"methodName": method, "params": [node, *arguments]}
            for method, node, arguments in calls[begin : begin + MAX_CALLS]
        ]
        values += await _multicall(master, part)
    return values


async def _multicall(master: MasterClient, calls: list[dict[str, Any]]) -> list[Any]:
    try:
        answers = await master.rpc.call(master.uri, "system.multicall", (calls,), timeout=master.timeout)
    except XmlRpcError as error:
        raise MasterUnreachableError(master.uri, str(error)) from error
    if not isinstance(answers, list) or len(answers) != len(calls):
        raise MasterUnreachableError(master.uri, "system.multicall was answered in no known form")
    return [_value(answer) for answer in answers]


def _value(answer: Any) -> Any:
    """Return the value of one answer in many: ``[[status, message, value]]``, or a fault."""
    match answer:
        case [[status, _, value]] if status == SUCCESS:
            return value
        case _:
            return None


class CoreSource:
    """Reads the graph of a core in this process, as soon as it changes."""

    def __init__(self, core: Core, watch: GraphWatch) -> None:
        self._core = core
        self._watch = watch
        self._changes = aiter(watch)

    async def read(self) -> Snapshot:
        """Read everything; never fails."""
        graph = self._core.graph
        publishers, subscribers, services = (read_names(part) for part in graph.system_state())
        addresses = {name: graph.service(name) for name in services}
        return Snapshot(
            publishers,
            subscribers,
            services,
            graph.topic_types,
            graph.nodes,
            {name: uri for name, uri in addresses.items() if uri},
            (os.getpid(), ""),
        )

    async def wait(self, longest: float) -> None:
        """Wait for the next change, and a moment for those that come with it."""
        if await self._changed(longest):
            await asyncio.sleep(SETTLE)
            while await self._changed(0):
                pass

    async def _changed(self, longest: float) -> bool:
        try:
            async with asyncio.timeout(longest):
                await anext(self._changes)
        except TimeoutError:
            return False
        return True


@asynccontextmanager
async def open_source(master: MasterClient, core: Core | None) -> AsyncIterator[MasterSource]:
    """Read from ``core`` if there is one, else from the master."""
    if core is None:
        yield RpcSource(master)
        return
    with core.watch() as watch:
        yield CoreSource(core, watch)


_ASK_RUN: Sequence[tuple[str, ...]] = (("getPid",), ("getParam", RUN_ID))


def _run(pid: Any, run_id: Any) -> Run:
    return pid if isinstance(pid, int) else 0, run_id if isinstance(run_id, str) else ""


def _known(names: Sequence[str], uris: Sequence[Any]) -> dict[str, str]:
    found = zip(names, uris, strict=True)
    return {name: uri for name, uri in found if isinstance(uri, str) and uri}
