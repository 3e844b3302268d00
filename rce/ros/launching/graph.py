"""The graph of a launch: its master, which is started if there is none, and its parameters."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import uuid
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import yaml

from rce.ros.core import Core
from rce.ros.core.server import DEFAULT_PORT
from rce.ros.errors import MalformedDocumentError, MasterRefusedError, MasterUnreachableError
from rce.ros.launch.exceptions import LaunchError
from rce.ros.node.master import MasterClient
from rce.ros.node.settings import LOOPBACK, is_loopback
from rce.ros.xmlrpc import RpcClient

if TYPE_CHECKING:
    from rce.ros.launch.plan import LaunchPlan, ParameterCommand

CALLER = "/roslaunch"
ANSWER_S = 3.0
"""How long a master may take to answer the first call."""
POLL_S = 0.5
"""Seconds between two looks for a master that is not there yet."""


class LaunchGraph:
    """A graph in which nodes are launched; a client of its master.

    Attributes:
        uri: The master's.
        is_own: Whether this program has started the master.
    """

    def __init__(self, uri: str, rpc: RpcClient, *, is_own: bool) -> None:
        self.uri = uri
        self.is_own = is_own
        self._master = MasterClient(uri, CALLER, "", rpc)

    async def run_id(self) -> str:
        """Return the run's id; a master that has none gets one.

        Raises:
            LaunchError: The master does not answer.
        """
        try:
            return str(await self._call("getParam", "/run_id"))
        except MasterRefusedError:
            run_id = str(uuid.uuid1())
            await self._call("setParam", "/run_id", run_id)
            return run_id

    async def apply(self, plan: LaunchPlan) -> None:
        """Carry out the commands of a plan, then clear and set its parameters.

        Raises:
            LaunchError: One of them cannot be carried out.
        """
        for command in plan.commands:
            await self._carry_out(command)
        for name in plan.cleared:
            await self._delete(name)
        for name, value in plan.parameters.items():
            try:
                await self._call("setParam", name, value)
            except (MasterRefusedError, MalformedDocumentError) as error:
                raise LaunchError(f"parameter {name} cannot be set: {error}") from error

    async def _carry_out(self, command: ParameterCommand) -> None:
        if command.command == "delete":
            await self._delete(command.name)
            return
        try:
            value = await self._call("getParam", command.name)
        except MasterRefusedError as error:
            raise LaunchError(f"parameter {command.name} cannot be dumped: {error}") from error
        try:
            await asyncio.to_thread(Path(command.file).write_text, yaml.safe_dump(value))
        except OSError as error:
            raise LaunchError(f"{command.file} cannot be written: {error.strerror}") from error

    async def _delete(self, name: str) -> None:
        if await self._call("hasParam", name):
            await self._call("deleteParam", name)

    async def _call(self, method: str, *arguments: Any) -> Any:
        try:
            return await self._master.call(method, *arguments)
        except MasterUnreachableError as error:
            raise LaunchError(f"{error}; was asked for {method} {arguments[0]}") from error


@asynccontextmanager
async def launch_graph(uri: str, log_folder: Path | None) -> AsyncIterator[LaunchGraph]:
    """Join the graph of a master, for the time of the block; start the master if there is none.

    Args:
        uri: The master's.
        log_folder: Where a started master keeps its log; None: nowhere.

    Raises:
        LaunchError: The master does not answer, and cannot be started here.
    """
    async with RpcClient() as rpc:
        if await _answers(uri, rpc):
            yield LaunchGraph(uri, rpc, is_own=False)
            return
        async with _own_core(uri, log_folder) as core:
            yield LaunchGraph(uri if urlsplit(uri).port else core.uri, rpc, is_own=True)


async def _answers(uri: str, rpc: RpcClient, timeout: float = ANSWER_S) -> bool:
    try:
        await MasterClient(uri, CALLER, "", rpc, timeout).call("getPid")
    except MasterUnreachableError:
        return False
    return True


async def wait_for_master(uri: str, stop: asyncio.Event) -> None:
    """Wait until a master answers, or an event is set."""
    async with RpcClient() as rpc:
        while not stop.is_set() and not await _answers(uri, rpc):
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), POLL_S)


@asynccontextmanager
async def _own_core(uri: str, log_folder: Path | None) -> AsyncIterator[Core]:
    parts = urlsplit(uri)
    host, port = parts.hostname or LOOPBACK, parts.port or DEFAULT_PORT
    if is_loopback(host):
        core = Core(LOOPBACK, port, rosout=True, log_folder=log_folder)
    elif _is_of_this_machine(host):
        # Nodes of other machines join by this name, those of this machine by any of its addresses.
        core = Core("0.0.0.0", port, advertised=host, rosout=True, log_folder=log_folder)  # noqa: S104
    else:
        raise LaunchError(f"no master answers at {uri}, and {host} is not an address of this machine")
    try:
        await core.__aenter__()
    except OSError as error:
        raise LaunchError(
            f"no master answers at {uri}, and none can be started there: {error.strerror or error}"
        ) from error
    try:
        yield core
    finally:
        await core.__aexit__(None, None, None)


def _is_of_this_machine(host: str) -> bool:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except OSError:
        return False
    return True


def parameters_as_yaml(parameters: Mapping[str, Any]) -> str:
    """Return parameters as ``roslaunch --dump-params`` prints them."""
    return str(yaml.safe_dump(dict(parameters)))
