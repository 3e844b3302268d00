"""Nodes notice that their core was restarted, forgot them, or knows another node of their name."""

from __future__ import annotations

import asyncio

import pytest

from rce.ros.core import Core
from rce.ros.node import Node, registrar

STRING = "std_msgs/String"


def port_of(core: Core) -> int:
    return int(core.uri.rstrip("/").rpartition(":")[2])


def has_all(core: Core) -> bool:
    state = [{name for name, _ in part} for part in core.graph.system_state()]
    return "/t" in state[0] and {"/u", "/v"} <= state[1] and {"/s", "/a/set_logger_level"} <= state[2]


async def test_a_restarted_core_is_told_everything_again() -> None:
    async with Core(port=0) as first:
        uri, port = first.uri, port_of(first)
        first.set_param("/watched", 1)
        a = await Node("a", argv=["_gain:=2"], master_uri=uri, intra_process=False).__aenter__()
        try:
            b = await Node("b", argv=[], master_uri=uri, intra_process=False).__aenter__()
            publisher = await a.advertise("t", STRING, latch=True)
            await a.subscribe("u", STRING)
            await a.subscribe_serialized("v", "*", lambda *_: None)
            await a.advertise_service("s", "std_srvs/Empty", lambda request: None)
            heard = await b.subscribe("t", STRING)
            told: asyncio.Queue[tuple[str, object]] = asyncio.Queue()
            assert await a.watch_param("/watched", lambda *change: told.put_nowait(change)) == 1
            await publisher.wait_for_subscribers(timeout=10)
        except BaseException:
            await a.__aexit__(None, None, None)
            raise
    try:
        publisher.publish(data="without a core")
        assert (await asyncio.wait_for(anext(aiter(heard)), 10)).data == "without a core"
        async with Core(port=port) as second:
            await second.wait_until(lambda _: has_all(second) and "/b" in second.graph.nodes, timeout=20)
            assert second.get_param("/a/gain") == 2
            publisher.publish(data="with another")
            assert (await asyncio.wait_for(anext(aiter(heard)), 10)).data == "with another"
            assert await asyncio.wait_for(told.get(), 10) == ("/watched", {})
            second.set_param("/watched", 3)
            assert await asyncio.wait_for(told.get(), 10) == ("/watched", 3)
            async with Node("c", argv=[], master_uri=uri) as c:
                assert await c.service_client("s", "std_srvs/Empty").call({}, timeout=10) is not None
            await a.__aexit__(None, None, None)
            await b.__aexit__(None, None, None)
            assert second.graph.system_state() == [[], [], []]
    finally:
        await a.__aexit__(None, None, None)
        await b.__aexit__(None, None, None)


async def test_a_core_that_forgot_is_told_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registrar, "CHECK_INTERVAL", 0.05)
    async with Core(port=0) as core, Node("a", argv=[], master_uri=core.uri) as a:
        await a.advertise("t", STRING)
        before = list(map(sorted, core.graph.system_state()))  # they register side by side
        core.forget_node("/a")
        await core.wait_until(lambda graph: list(map(sorted, graph.system_state())) == before, timeout=10)


async def test_a_node_whose_name_was_taken_meanwhile_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registrar, "CHECK_INTERVAL", 0.05)
    async with Core(port=0) as core, Node("a", argv=[], master_uri=core.uri) as a:
        core.forget_node("/a")
        core._perform(core.graph.register_publisher("/t", STRING, "/a", "http://127.0.0.1:1/"))
        await asyncio.wait_for(a.spin(), 10)
        assert core.graph.nodes["/a"] == "http://127.0.0.1:1/"
