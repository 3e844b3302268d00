"""Actions while time is what ``/clock`` says: slow, fast, standing still and jumping back."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from support.ros_nodes import MakeNode

from rce.ros.actions import ActionClient, ActionServer, GoalState, ServerGoal, SimpleActionServer
from rce.ros.actions.tracker import SilenceClock
from rce.ros.core import Core
from rce.ros.node import Node, Publisher
from rce.ros.types import Time

FIBONACCI = "actionlib_tutorials/FibonacciAction"


class World:
    """Sets the time of nodes."""

    def __init__(self, publisher: Publisher, nodes: tuple[Node, ...]) -> None:
        self._publisher = publisher
        self._nodes = nodes

    async def set(self, seconds: float) -> None:
        self._publisher.publish(clock=Time.from_sec(seconds))
        async with asyncio.timeout(60):
            while any(node.time() != seconds for node in self._nodes):
                await asyncio.sleep(0)


@asynccontextmanager
async def simulation(core: Core, make_node: MakeNode) -> AsyncIterator[tuple[World, Node, Node]]:
    core.set_param("/use_sim_time", True)
    async with make_node("world") as world, make_node("server") as a, make_node("client") as b:
        publisher = await world.advertise("/clock", "rosgraph_msgs/Clock")
        await publisher.wait_for_subscribers(3, timeout=10)
        made = World(publisher, (a, b))
        await made.set(100.0)
        yield made, a, b


async def test_a_handler_sleeps_in_simulated_time(core: Core, make_node: MakeNode) -> None:
    slept = asyncio.Event()

    async def handler(goal: ServerGoal) -> None:
        while await goal.sleep(1000.0):
            slept.set()

    async with (
        simulation(core, make_node) as (world, a, b),
        ActionServer(a, "job", FIBONACCI, handler),
        ActionClient(b, "job", FIBONACCI) as client,
        asyncio.timeout(30),
    ):
        goal = await client.send(order=1)
        assert goal.stamp == Time(100, 0)
        while goal.state is not GoalState.ACTIVE:
            await asyncio.sleep(0.01)
        await world.set(1099.0)
        assert not slept.is_set()
        await world.set(1100.0)
        await slept.wait()
        goal.cancel()  # time stands still; that wakes it nevertheless
        assert await goal.wait() is GoalState.PREEMPTED


async def test_a_server_is_not_missed_while_time_stands_still(core: Core, make_node: MakeNode) -> None:
    core.set_param("/actionlib_status_frequency", 0.001)  # a server in a simulation that pauses

    async def handler(goal: ServerGoal) -> None:
        await goal.wait_for_cancel()

    async with (
        simulation(core, make_node) as (world, a, b),
        ActionServer(a, "job", FIBONACCI, handler),
        ActionClient(b, "job", FIBONACCI, silence_timeout=0.3) as client,
        asyncio.timeout(30),
    ):
        goal = await client.send(order=1)
        with pytest.raises(TimeoutError):
            await goal.wait(timeout=1.0)
        assert goal.state is GoalState.ACTIVE
        seconds = 100.0
        while not goal.is_done:  # it continues, and the server says nothing
            seconds += 0.0625
            await world.set(seconds)
            await asyncio.sleep(0.05)
        assert (goal.state, goal.text) == (GoalState.LOST, "the server is silent")


async def test_goals_after_a_jump_back_are_new_ones(core: Core, make_node: MakeNode) -> None:
    async def handler(goal: ServerGoal) -> dict[str, list[int]] | None:
        if goal.request.order == 1:
            await goal.wait_for_cancel()
            return None
        return {"sequence": [goal.request.order]}

    async with (
        simulation(core, make_node) as (world, a, b),
        ActionServer(a, "job", FIBONACCI, handler),
        ActionClient(b, "job", FIBONACCI) as client,
        asyncio.timeout(30),
    ):
        await client.wait_for_server()
        client.cancel_before(b.now())
        late = await client.send(order=1)  # of the same time
        # The two topics have connections of their own, so the goal may come first.
        assert await late.wait() in (GoalState.RECALLED, GoalState.PREEMPTED)
        await world.set(5.0)
        again = await client.send(order=2)
        assert list((await again.result()).sequence) == [2]


async def test_simple_server_works_after_a_jump_back(core: Core, make_node: MakeNode) -> None:
    async def handler(goal: ServerGoal) -> dict[str, list[int]]:
        return {"sequence": [goal.request.order]}

    async with (
        simulation(core, make_node) as (world, a, b),
        SimpleActionServer(a, "job", FIBONACCI, handler),
        ActionClient(b, "job", FIBONACCI) as client,
        asyncio.timeout(60),
    ):
        for seconds in (500.0, 1.0):
            await world.set(seconds)
            goal = await client.send(order=2)
            assert goal.stamp == Time(int(seconds), 0)
            assert list((await goal.result()).sequence) == [2]


def test_silence_counts_what_passed_for_both() -> None:
    machine, graph = 10.0, 1000.0
    clock = SilenceClock(lambda: machine, lambda: graph)
    seen = [clock.now()]
    for machine_step, graph_step in ((1, 1), (1, 0), (1, 100), (1, -500), (1, 0.25)):
        machine += machine_step
        graph += graph_step
        seen.append(clock.now())
    assert seen == [10, 11, 11, 12, 12, 12.25]
