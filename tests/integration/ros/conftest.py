"""A core to meet at, under both event loops."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from functools import partial

import pytest
import uvloop
from support.ros_nodes import MakeNode

from rce.ros.core import Core
from rce.ros.node import Node


def pytest_asyncio_loop_factories() -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}


@pytest.fixture
async def core() -> AsyncIterator[Core]:
    async with Core(port=0) as core:
        yield core
        core.graph.validate()


@pytest.fixture
def make_node(core: Core) -> MakeNode:
    """Nodes that talk over sockets, as those of several processes do."""
    return partial(Node, argv=[], master_uri=core.uri, intra_process=False)


# libuv keeps one pipe for signals from its first loop on; here, it is none of a test's leaks.
uvloop.new_event_loop().close()
