"""roscpp's client library at our core and with our nodes, and the same at a real core."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable
from typing import Any

import pytest
from support.ros_nodes import MakeGraphNode
from support.ros_real import TIMEOUT_S, Graph, interrupt

from rce.ros.errors import ServiceFaultError
from rce.ros.node import Node, Publisher
from rce.ros.types import Message, Time

pytestmark = [pytest.mark.needs("roscpp", "roslaunch"), pytest.mark.timeout(600)]

STRING = "std_msgs/String"
SET_BOOL = "std_srvs/SetBool"
CLOCK_STEP = 0.02
"""Seconds of simulated time between ticks."""


class Program:
    """One part of the program, running; knows what it has printed."""

    def __init__(self, output: asyncio.StreamReader) -> None:
        self._output = output
        self.lines: list[str] = []

    async def says(self, words: str = "done") -> list[str]:
        """Wait for a line; return all lines until then."""
        async with asyncio.timeout(TIMEOUT_S):
            while words not in self.lines:
                line = await self._output.readline()
                assert line, f"it ended and said {self.lines}"
                self.lines.append(line.decode().rstrip())
        return self.lines


@contextlib.asynccontextmanager
async def running(graph: Graph, program: str, part: str) -> AsyncIterator[Program]:
    process = await asyncio.create_subprocess_exec(
        program, part, env=graph.env, cwd=graph.home, stdout=asyncio.subprocess.PIPE, start_new_session=True
    )
    assert process.stdout is not None
    try:
        yield Program(process.stdout)
    finally:
        await interrupt(process)


async def until_set(node: Node, name: str, value: object) -> None:
    """Wait until the program has set a parameter."""
    async with asyncio.timeout(TIMEOUT_S):
        while await node.get_param(name, None) != value:
            await asyncio.sleep(0.01)


async def test_parameters(graph: Graph, make_node: MakeGraphNode, roscpp_library: str) -> None:
    """Of all types, cached ones too: those that another node changes or deletes."""
    async with make_node(graph, "ours") as node:
        await node.set_param("/lib/cached", 1)
        async with running(graph, roscpp_library, "parameters") as program:
            await until_set(node, "/lib/ask", 1)
            assert await node.get_param("/lib/text") == 'a <b> & "c" é'
            assert await node.get_param("/lib/ints") == [1, 2, 3]
            await node.set_param("/lib/cached", 2)
            await until_set(node, "/lib/ask", 2)
            await node.set_param("/lib/tree", {"leaf": 3})
            await until_set(node, "/lib/ask", 3)
            await node.delete_param("/lib/cached")
            assert await program.says() == [
                "int 7",
                "double 25",
                "int as double 7",
                "text as int 0",
                "bool 1",
                'text a <b> & "c" é',
                "ints 3",
                "map 13",
                "tree 7",
                "has 1",
                "default else",
                "search 1",
                "found /lib/int",
                "deleted 1",
                "names 6",
                "cached first 1",
                "cached changed 2",
                "cached leaf 3",
                "cached gone",
                "done",
            ]


async def test_latching(graph: Graph, make_node: MakeGraphNode, roscpp_library: str) -> None:
    """In both directions, to those that come late and those that come again."""
    async with make_node(graph, "ours") as node:
        latched = await node.advertise("our_latched", STRING, latch=True)
        latched.publish(data="old")
        latched.publish(data="kept")
        async with running(graph, roscpp_library, "latching") as program:
            await program.says("says so 1")
            late = await node.subscribe("cpp_latched", STRING)
            async with asyncio.timeout(TIMEOUT_S):
                assert (await anext(aiter(late))).data == "two"
            latched.publish(data="newer")
            assert await program.says() == ["near two", "late kept 5", "says so 1", "kept newer", "done"]


async def test_a_publisher_leaves_under_load(
    graph: Graph, make_node: MakeGraphNode, roscpp_library: str
) -> None:
    """Twenty times, while its messages wait to be sent; our subscriber finds it each time."""
    epochs: set[str] = set()
    async with make_node(graph, "ours") as node:
        await node.subscribe("load", STRING, lambda message: epochs.add(message.data))
        async with running(graph, roscpp_library, "unadvertise") as program:
            assert await program.says() == ["published epochs", "done"]
        await graph.until(lambda: nothing(graph.publishers("/load")), what="the publisher is gone")
    assert len(epochs) > 10, epochs


async def nothing(found: Awaitable[list[str]]) -> bool:
    return not await found


async def test_a_subscriber_leaves_under_load(
    graph: Graph, make_node: MakeGraphNode, roscpp_library: str
) -> None:
    """Twenty times, while our node publishes without a pause."""
    async with make_node(graph, "ours") as node:
        load = await node.advertise("our_load", STRING, queue_size=10)
        async with running(graph, roscpp_library, "resubscribe") as program, asyncio.TaskGroup() as tasks:
            publishing = tasks.create_task(publish(load))
            assert await program.says() == ["heard epochs", "done"]
            publishing.cancel()
        async with asyncio.timeout(TIMEOUT_S):
            while load.connections:
                await asyncio.sleep(0.01)


async def publish(load: Publisher) -> None:
    while True:
        load.publish(data="x" * 100)
        await asyncio.sleep(0.0005)


async def test_services(graph: Graph, make_node: MakeGraphNode, roscpp_library: str) -> None:
    """Single and persistent calls, refused ones, services that are closed and opened again."""

    def set_bool(request: Message) -> dict[str, Any]:
        if not request.data:
            raise ServiceFaultError("/our_set", "no")
        return {"success": True, "message": "ours"}

    async with make_node(graph, "ours") as node:
        services = {"set": await node.advertise_service("our_set", SET_BOOL, set_bool)}

        async def switch(request: Message) -> dict[str, Any]:
            if request.data:
                services["set"] = await node.advertise_service("our_set", SET_BOOL, set_bool)
            else:
                await services["set"].close()
            return {"success": True, "message": ""}

        await node.advertise_service("our_switch", SET_BOOL, switch)
        async with running(graph, roscpp_library, "services") as program:
            await until_set(node, "/lib/served", 0)
            client = node.service_client("cpp_set", SET_BOOL)
            for _ in range(200):
                assert (await client.call({"data": True}, timeout=TIMEOUT_S)).message == "cpp"
            with pytest.raises(ServiceFaultError):
                await client.call({"data": False}, timeout=TIMEOUT_S)
            await node.set_param("/lib/called", True)
            await until_set(node, "/lib/served", 1)
            assert await graph.service("/cpp_set") is None
            assert await program.says() == [
                "there 1",
                "call 1",
                "answer ours",
                "refused 0",
                "persistent 200",
                "refused again 0",
                "still there 1",
                "at once 200",
                "own 1",
                "valid 1",
                "closed 1",
                "call of a closed one 0",
                "valid then 0",
                "exists 0",
                "opened 1",
                "call of an opened one 1",
                "served 202",
                "exists then 0",
                "done",
            ]


async def test_timers_in_simulated_time(graph: Graph, make_node: MakeGraphNode, roscpp_library: str) -> None:
    """A node of ours is the clock; it jumps back once."""
    async with make_node(graph, "ours") as node:
        await node.set_param("/use_sim_time", True)
        clock = await node.advertise("/clock", "rosgraph_msgs/Clock")
        async with running(graph, roscpp_library, "timers") as program, asyncio.TaskGroup() as tasks:
            ticking = tasks.create_task(tick(clock, 100.0))
            await until_set(node, "/lib/jump", 1)
            ticking.cancel()
            ticking = tasks.create_task(tick(clock, 10.0))
            assert await program.says() == [
                "simulated 1",
                "slept 1",
                "fired 1",
                "once 1",
                "in order 1",
                "rate 1",
                "stopped 1",
                "fires after a jump",
                "done",
            ]
            ticking.cancel()


async def tick(clock: Publisher, seconds: float) -> None:
    """Publish the time, from ``seconds`` on, as fast as it goes: a busy machine stops a program for a while,
    in which the time must not pass by whole timers."""
    step = 0
    while True:
        now = seconds + step * CLOCK_STEP
        clock.publish(clock=Time(int(now), int(now % 1 * 1e9)))
        step += 1
        await asyncio.sleep(CLOCK_STEP)
