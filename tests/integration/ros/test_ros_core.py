"""The core as nodes and its host see it: parameters, watching, nodes that die or come twice."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
from collections.abc import Callable
from typing import Any
from xmlrpc.client import ServerProxy

import pytest
from support.ros_busy_node import answering_second_call
from support.ros_nodes import MakeNode

from rce.ros.core import Change, Core, GraphEvent, notifier
from rce.ros.core.notifier import CALL_TIMEOUT
from rce.ros.errors import (
    MasterRefusedError,
    ParameterMissingError,
    ParameterValueError,
    RemoteFaultError,
)
from rce.ros.node import Node
from rce.ros.xmlrpc import Dispatcher, RpcClient, RpcServer, server
from rce.ros.xmlrpc.codec import encode_call

STRING = "std_msgs/String"


async def test_parameters(core: Core, make_node: MakeNode) -> None:
    async with make_node("a", namespace="ns", argv=["_gain:=2.5"]) as a:
        assert await a.get_param("~gain") == 2.5
        await a.set_param("rel", {"list": [1, 2.5, "x", True], "deep": {"text": "ä <&> \r\n"}})
        assert await a.get_param("/ns/rel/deep/text") == "ä <&> \r\n"
        assert await a.get_param("rel/list") == [1, 2.5, "x", True]
        assert await a.has_param("rel/deep")
        assert await a.search_param("rel/list") == "/ns/rel/list"
        await a.delete_param("rel/list")
        assert not await a.has_param("rel/list")
        assert await a.get_param("rel/list", "default") == "default"
        with pytest.raises(ParameterMissingError, match="/ns/rel/list"):
            await a.get_param("rel/list")
        with pytest.raises(ParameterMissingError):
            await a.delete_param("rel/list")
        names = {name for name in await a.get_param_names() if not name.startswith("/roslaunch/uris/host_")}
        assert names == {
            "/rosdistro", "/rosversion", "/run_id", "/ns/a/gain", "/ns/rel/deep/text",
        }  # fmt: skip
        assert core.get_param("/ns/a/gain") == 2.5
        core.set_param("/host", 1)
        assert await a.get_param("/host") == 1
        assert core.delete_param("/host")
        assert not core.delete_param("/host")
        with pytest.raises(ParameterMissingError):
            core.get_param("/host")


@pytest.mark.parametrize(
    ("value", "place"),
    [
        (None, "/odd"),
        ({"deep": [1, {"wide": 2**40}]}, "/odd/deep[1]/wide"),
        ({"text": "\x00"}, "/odd/text"),
        ({"keys": {1: 2}}, "/odd/keys"),
    ],
)
async def test_a_value_that_cannot_be_sent_is_named(make_node: MakeNode, value: object, place: str) -> None:
    async with make_node("a") as node:
        with pytest.raises(ParameterValueError) as raised:
            await node.set_param("/odd", value)
        assert raised.value.name == place
        assert not await node.has_param("/odd")


async def test_parameter_changes_are_told(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        told: asyncio.Queue[tuple[str, object]] = asyncio.Queue()
        assert await a.watch_param("/x", lambda name, value: told.put_nowait((name, value))) == {}
        await b.set_param("/x", 1)
        assert await asyncio.wait_for(told.get(), 10) == ("/x", 1)
        await b.set_param("/x/y", 2)
        assert await asyncio.wait_for(told.get(), 10) == ("/x/y", 2)


async def test_the_host_watches_the_graph(core: Core, make_node: MakeNode) -> None:
    with core.watch() as events:
        async with make_node("a") as a:
            await a.advertise("t", STRING)
            await core.wait_until(lambda graph: "/t" in graph.topic_types, timeout=10)
        found: list[GraphEvent] = []
        async with asyncio.timeout(60):
            async for event in events:
                found.append(event)
                if event.change is Change.NODE_VANISHED:
                    break
        assert found[0] == GraphEvent(Change.NODE_APPEARED, "/a")
        assert GraphEvent(Change.PUBLISHER_ADDED, "/a", "/t") in found
        assert GraphEvent(Change.PUBLISHER_REMOVED, "/a", "/t") in found
    with pytest.raises(TimeoutError):
        await core.wait_until(lambda graph: "/a" in graph.nodes, timeout=0.05)


async def test_of_two_nodes_of_one_name_the_older_stops(core: Core, make_node: MakeNode) -> None:
    async with make_node("same") as older:
        subscriber = await older.subscribe("t", STRING)
        async with make_node("same") as newer:
            await asyncio.wait_for(older.spin(), 10)
            assert older.is_shutdown
            assert [message async for message in subscriber] == []
            assert core.graph.nodes == {"/same": newer.uri}
            assert not newer.is_shutdown
            assert await newer.sleep(0)
        assert not await older.sleep(60)


async def test_a_dead_node_stalls_nobody(core: Core, make_node: MakeNode) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        silent_uri, refusing_uri = f"http://127.0.0.1:{silent.getsockname()[1]}/", "http://127.0.0.1:1/"
        async with RpcClient() as rpc, make_node("b") as b, make_node("a") as a:
            for node, uri in (("/silent", silent_uri), ("/refusing", refusing_uri)):
                await rpc.call(core.uri, "registerSubscriber", (node, "/t", STRING, uri))
            subscriber = await b.subscribe("t", STRING)
            await a.advertise("t", STRING)
            await subscriber.wait_for_publishers(timeout=0.9 * CALL_TIMEOUT)
            assert core.forget_node("/refusing")
            assert not core.forget_node("/refusing")
            assert core.forget_node("/silent")
            assert core.graph.subscribers("/t") == {"/b": b.uri}


@pytest.mark.parametrize("first", ["is not answered", "loses its connection"])
async def test_a_busy_node_is_told_of_a_publisher_later(
    core: Core, make_node: MakeNode, monkeypatch: pytest.MonkeyPatch, first: str
) -> None:
    """A node that did not answer is called again: else it never hears of the publisher."""
    monkeypatch.setattr(notifier, "CALL_TIMEOUT", 0.5)
    calls: asyncio.Queue[bytes] = asyncio.Queue()
    loses = first == "loses its connection"
    async with answering_second_call(calls, loses=loses) as uri, RpcClient() as rpc, make_node("a") as a:
        await rpc.call(core.uri, "registerSubscriber", ("/busy", "/t", STRING, uri))
        await a.advertise("t", STRING)
        await _until(lambda: calls.qsize() == 2)
        told = calls.get_nowait()
        assert a.uri.encode() in told
        assert calls.get_nowait() == told


async def test_a_killed_process_is_forgotten_when_the_host_says_so(core: Core, make_node: MakeNode) -> None:
    program = """
import asyncio, sys
from rce.ros.node import Node
async def main():
    async with Node("victim", argv=[], master_uri=sys.argv[1]) as node:
        await node.advertise_service("s", "std_srvs/Empty", lambda request: None)
        publisher = await node.advertise("t", "std_msgs/String", latch=True)
        publisher.publish(data="alive")
        await node.spin()
asyncio.run(main())
"""
    async with make_node("b") as b:
        subscriber = await b.subscribe("t", STRING)
        victim = await asyncio.create_subprocess_exec(sys.executable, "-c", program, core.uri)
        try:
            async with asyncio.timeout(60):
                assert (await anext(aiter(subscriber))).data == "alive"
            victim.send_signal(signal.SIGKILL)
        finally:
            await victim.wait()
        assert "/victim" in core.graph.nodes
        assert core.forget_node("/victim")
        assert core.graph.service("/s") is None
        async with make_node("heir") as heir:
            publisher = await heir.advertise("t", STRING)
            await publisher.wait_for_subscribers(timeout=10)


async def test_a_node_registers_again_at_a_core_that_was_restarted(make_node: MakeNode) -> None:
    async with Core(port=0) as first:
        port = int(first.uri.rstrip("/").rpartition(":")[2])
        uri = first.uri
    async with Core(port=port) as core, Node("a", argv=[], master_uri=uri) as a:
        await a.advertise("t", STRING)
        await a.subscribe("u", STRING)
        await a.advertise_service("s", "std_srvs/Empty", lambda request: None)
        before = list(map(sorted, core.graph.system_state()))
        core.forget_node("/a")
        assert core.graph.nodes == {}
        await a.reregister()
        assert list(map(sorted, core.graph.system_state())) == before


async def test_questions_to_the_core(core: Core, make_node: MakeNode) -> None:
    async with make_node("a", namespace="ns") as a:
        await a.advertise("t", STRING)
        ask = a._running.master.call
        assert await ask("getUri") == core.uri
        assert await ask("getPid") == os.getpid()
        assert await ask("lookupNode", "/ns/a") == a.uri
        assert await ask("getPublishedTopics", "") == [["/rosout", "rosgraph_msgs/Log"], ["/ns/t", STRING]]
        assert await ask("getPublishedTopics", "/ns") == [["/ns/t", STRING]]
        assert await ask("unregisterPublisher", "/ns/t", "http://other:1/") == 0
        with pytest.raises(MasterRefusedError, match="unknown node"):
            await ask("lookupNode", "/nobody")


async def test_http_is_spoken_as_clients_do(core: Core) -> None:
    host, _, port = core.uri.removeprefix("http://").rstrip("/").partition(":")
    body = encode_call("getPid", ("/x",))
    post = b"POST /RPC2 HTTP/1.%d\r\nHost: x\r\nContent-Type: text/xml\r\nContent-length: %d\r\n%s\r\n"
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write((post % (1, len(body), b"") + body) * 2 + post % (1, len(body), b"Expect: 100-continue\r\n"))
    async with asyncio.timeout(60):
        for _ in range(2):
            head = await reader.readuntil(b"\r\n\r\n")
            assert head.startswith(b"HTTP/1.1 200 OK\r\n")
            length = int(head.partition(b"Content-length: ")[2].split(b"\r\n")[0])
            assert str(os.getpid()).encode() in await reader.readexactly(length)
        assert b"100" in await reader.readuntil(b"\r\n\r\n")
        writer.write(body)
        assert b"200 OK" in await reader.readuntil(b"\r\n\r\n")
        writer.close()
        await writer.wait_closed()
        for request in (
            post % (0, len(body), b"") + body,
            b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
            b"garbage\r\n\r\n",
        ):
            reader, writer = await asyncio.open_connection(host, int(port))
            writer.write(request)
            assert (await reader.read()).startswith(b"HTTP/1.1 ")
            writer.close()
            await writer.wait_closed()


async def test_unknown_methods_are_faults(core: Core) -> None:
    async with RpcClient() as rpc:
        with pytest.raises(RemoteFaultError):
            await rpc.call(core.uri, "noSuchThing", ("/x",))
        assert "registerPublisher" in await rpc.call(core.uri, "system.listMethods", ())


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("/big", b"<i8>1099511627776</i8>", "beyond 32 bits"),
        ("/big", b"<array><data><value><i8>-2147483649</i8></value></data></array>", "beyond 32 bits"),
        ("/deep" * 60, b"<int>1</int>", "nested deeper"),
        ("/deep" * 3000, b"<int>1</int>", "nested deeper"),
    ],
    ids=["integer", "integer in a list", "name", "very long name"],
)
async def test_a_parameter_that_cannot_be_answered_is_refused(
    core: Core, name: str, value: bytes, problem: str
) -> None:
    """Else no client could read all parameters, or their names, any more."""
    document = encode_call("setParam", ("/x", name, "VALUE")).replace(b"<string>VALUE</string>", value)
    async with RpcClient() as rpc:
        status, text, _ = await rpc.send(core.uri, "setParam", document)
        assert (status, problem in text) == (-1, True), text
        await rpc.call(core.uri, "setParam", ("/x", "/deep" * 40, [2**31 - 1, {"a": -(2**31)}]))
        assert (await rpc.call(core.uri, "getParam", ("/x", "/")))[0] == 1
        assert (await rpc.call(core.uri, "getParamNames", ("/x",)))[0] == 1


async def test_a_repeated_update_comes_before_later_ones(core: Core) -> None:
    """The update of a namespace must not undo that of a parameter in it, which was set later."""
    calls: asyncio.Queue[bytes] = asyncio.Queue()
    async with answering_second_call(calls, loses=True) as uri, RpcClient() as rpc:
        await rpc.call(core.uri, "subscribeParam", ("/n", uri, "/a"))
        core.set_param("/a", {"b": 1})
        core.set_param("/a/b", 2)
        await _until(lambda: calls.qsize() == 2)
        first, second = calls.get_nowait(), calls.get_nowait()
        assert b"<string>/a/</string>" in first
        assert second == first


async def test_node_without_subscription_is_left_alone(core: Core) -> None:
    """A node that knows nothing of a subscription is left alone."""
    calls: list[str] = []
    answers = [1, -1]

    def update(_caller: str, key: str, _value: object) -> tuple[int, str, int]:
        calls.append(key)
        return answers[len(calls) - 1], "", 0

    async with RpcServer(Dispatcher({"paramUpdate": update}), "127.0.0.1") as slave, RpcClient() as rpc:
        uri = f"http://127.0.0.1:{slave.port}/"
        await rpc.call(core.uri, "subscribeParam", ("/n", uri, "/p"))
        core.set_param("/p", 1)
        await _until(lambda: len(calls) == 1)
        assert core.graph.nodes == {"/n": uri}
        core.set_param("/p", 2)
        await core.wait_until(lambda graph: not graph.nodes, timeout=10)
        core.set_param("/p", 3)
        assert calls == ["/p/", "/p/"]


async def test_a_core_is_told_to_end_only_if_its_program_lets_it(core: Core) -> None:
    told: list[str] = []
    async with Core(port=0, on_shutdown=told.append) as mortal, RpcClient() as rpc:
        assert (await rpc.call(core.uri, "shutdown", ("/x", "why")))[0] == -1
        assert await rpc.call(mortal.uri, "shutdown", ("/x", "why")) == [1, "shutdown", 0]
    assert told == ["/x asked for it: why"]


async def test_a_large_graph(core: Core) -> None:
    """Hundreds of nodes come at once, with topics that all hear of, and thousands of parameters."""
    nodes, parameters = 200, 5000
    async with RpcClient() as rpc:

        async def call(method: str, *arguments: object) -> None:
            await rpc.call(core.uri, method, arguments, timeout=120)

        async def join(number: int) -> None:
            caller, uri = f"/n{number}", f"http://127.0.0.1:1/{number}"
            tree = f"/tree/b{number}"
            await call("registerSubscriber", caller, "/all", STRING, uri)
            await call("registerPublisher", caller, "/all", STRING, uri)
            await call("subscribeParam", caller, uri, tree)
            await call("setParam", caller, tree, {"x": number, "y": [number]})

        async with asyncio.TaskGroup() as group:
            for number in range(nodes):
                group.create_task(join(number))
        assert len(core.graph.nodes) == len(core.graph.publishers("/all")) == nodes
        many = {f"p{number}": {"value": number} for number in range(parameters)}
        await rpc.call(core.uri, "setParam", ("/x", "/many", many), timeout=120)
        status, _, known = await rpc.call(core.uri, "getParamNames", ("/x",), timeout=120)
        assert status == 1
        assert len(known) == 2 * nodes + parameters + 4  # and the core's own
        assert (await rpc.call(core.uri, "getParam", ("/x", "/many"), timeout=120))[2] == many
        for number in range(nodes):
            assert core.forget_node(f"/n{number}")
        assert core.graph.nodes == core.graph.topic_types == {}


async def test_calls_of_a_tool_share_a_connection(core: Core, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of rosnode and rostopic, whose client is the standard library's: each connection costs time."""
    opened = 0
    made = server._Connection.connection_made

    def counted(connection: server._Connection, transport: asyncio.BaseTransport) -> None:
        nonlocal opened
        opened += 1
        made(connection, transport)

    def ask() -> list[int]:
        with ServerProxy(core.uri) as master:
            tool: Any = master  # a call gives any value
            return [tool.getSystemState("/tool")[0] for _ in range(10)]

    monkeypatch.setattr(server._Connection, "connection_made", counted)
    assert await asyncio.to_thread(ask) == [1] * 10
    assert opened == 1


async def _until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.01)
