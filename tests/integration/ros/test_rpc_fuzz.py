"""Requests over HTTP that no ROS program would send: no server of a ROS API answers with its own fault."""

from __future__ import annotations

from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import pytest
from support.fuzzing import Tracebacks, exchange, requests
from support.multimaster import DiscoveryNetwork

from rce.ros.multimaster.discovery import Discovery

if TYPE_CHECKING:
    from support.ros_nodes import MakeNode

    from rce.ros.core import Core

COUNT = 100
SERVERS = ("core", "node", "discovery")
FAULTS = {500, 502, 504}
"""501 is the answer to transfer codings that a server does not know."""


async def port_of(server: str, core: Core, make_node: MakeNode, stack: AsyncExitStack) -> int:
    """Start a server, if it does not run yet."""
    if server == "discovery":
        settings = DiscoveryNetwork().settings(core.uri)
        await stack.enter_async_context(Discovery(settings, core=core))
        return settings.rpc_port_for(core.uri)
    uri = core.uri if server == "core" else (await stack.enter_async_context(make_node("n"))).uri
    return int(uri.rpartition(":")[2].rstrip("/"))


@pytest.mark.parametrize("server", SERVERS)
async def test_raw_requests(server: str, core: Core, make_node: MakeNode) -> None:
    async with AsyncExitStack() as stack:
        port = await port_of(server, core, make_node, stack)
        with Tracebacks().watching() as log:
            for request in requests(["/", "/RPC2", "*", "http://[::1"], COUNT):
                answers = await exchange(port, request)
                assert not FAULTS & set(answers), request
                assert not log.found, (request, log.found)


@pytest.mark.parametrize("version", [b"1.0", b"1.1"])
async def test_head_gets_an_answer_without_body(version: bytes, core: Core) -> None:
    port = int(core.uri.rpartition(":")[2].rstrip("/"))
    with Tracebacks().watching() as log:
        request = b"HEAD / HTTP/%b\r\nHost: a\r\n\r\n" % version
        assert await exchange(port, request, whole=True) == [405]
        assert not log.found
