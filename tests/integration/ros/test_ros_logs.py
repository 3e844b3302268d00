"""Logs: gathered by the core, with levels that can be set."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from rce.ros.core import Core
from rce.ros.errors import ServiceFault
from rce.ros.node import Node
from rce.ros.node.rosout import KIND, MD5SUM
from rce.ros.types import TypeRegistry
from rce.ros.xmlrpc import RpcClient


@pytest.fixture
async def full_core() -> AsyncIterator[Core]:
    async with Core(port=0, rosout=True) as core:
        yield core
        core.graph.validate()


def test_the_log_has_the_checksum_of_its_type() -> None:
    assert TypeRegistry().message(KIND).md5sum == MD5SUM


async def test_records_of_all_nodes_are_gathered(full_core: Core) -> None:
    uri = full_core.uri
    assert full_core.graph.topic_types == {"/rosout": KIND, "/rosout_agg": KIND}
    async with (
        Node("a", argv=[], master_uri=uri) as a,
        Node("b", argv=[], master_uri=uri, intra_process=False) as b,
        Node("viewer", argv=[], master_uri=uri, rosout=False) as viewer,
    ):
        heard = await viewer.subscribe("/rosout_agg", KIND)
        await heard.wait_for_publishers(timeout=10)
        levels = {"debug": 1, "info": 2, "warning": 4, "error": 8, "critical": 16}
        for node in (a, b):
            node.log.setLevel("DEBUG")
            for level in levels:
                getattr(node.log, level)("%s of %s", level, node.name)
        found = set()
        async with asyncio.timeout(10):
            async for record in heard:
                found.add((record.name, record.level, record.msg))
                if len(found) == 10:
                    break
        expected = {(n, value, f"{level} of {n}") for level, value in levels.items() for n in ("/a", "/b")}
        assert found == expected


async def test_levels_are_read_and_set(core: Core) -> None:
    async with (
        Node("levels", argv=[], master_uri=core.uri) as a,
        Node("b", argv=[], master_uri=core.uri) as b,
    ):
        a.log.setLevel("INFO")  # as nodes begin; loggers outlive their node
        a.log.getChild("part").setLevel("ERROR")
        get = b.service_client("/levels/get_loggers", "roscpp/GetLoggers")
        set_level = b.service_client("/levels/set_logger_level", "roscpp/SetLoggerLevel")
        loggers = {entry.name: entry.level for entry in (await get.call({}, timeout=10)).loggers}
        assert loggers["rosout"] == "info"
        assert loggers["rosout.part"] == "error"
        await set_level.call({"logger": "rosout", "level": "Debug"}, timeout=10)
        loggers = {entry.name: entry.level for entry in (await get.call({}, timeout=10)).loggers}
        assert loggers["rosout"] == "debug"
        with pytest.raises(ServiceFault, match="no logger"):
            await set_level.call({"logger": "other", "level": "info"}, timeout=10)
        with pytest.raises(ServiceFault, match="not one of"):
            await set_level.call({"logger": "rosout", "level": "loud"}, timeout=10)


async def test_the_core_answers_as_a_roslaunch_process_does(core: Core) -> None:
    (uri,) = core.get_param("/roslaunch/uris").values()
    assert uri == core.uri
    async with RpcClient() as rpc:
        assert (await rpc.call(uri, "get_pid", ()))[0] == 1
        assert await rpc.call(uri, "get_node_names", ()) == [1, "node names", []]
        assert (await rpc.call(uri, "list_processes", ()))[2] == [[], []]
        assert (await rpc.call(uri, "process_info", ("x",)))[0] == -1
