"""Registrations that several handles share, and those that fail or are cancelled while the master is slow."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partialmethod
from typing import Any
from xmlrpc.client import ServerProxy

import pytest
from support.ros_masters import HoldingMaster, serving
from support.ros_nodes import MakeNode

from rce.ros.core import Core
from rce.ros.errors import MasterRefusedError, MasterUnreachableError
from rce.ros.node import Node, Publisher, Subscriber, registrations
from rce.ros.node.master import MasterClient

STRING = "std_msgs/String"

Register = Callable[[Node], Awaitable[object]]

KINDS: dict[str, Register] = {
    "Publisher": lambda node: node.advertise("/t", STRING),
    "Subscriber": lambda node: node.subscribe("/t", STRING),
    "Service": lambda node: node.advertise_service("/t", "std_srvs/Empty", lambda _: None),
}


@pytest.fixture
async def master(core: Core) -> AsyncIterator[HoldingMaster]:
    master = HoldingMaster(core.uri, "/t")
    async with serving(master) as uri:
        master.uri = uri
        yield master
        master.release()


def node_at(master: HoldingMaster) -> Node:
    return Node("a", argv=[], master_uri=master.uri, intra_process=False, signals=False)


async def begin(register: Register, node: Node, master: HoldingMaster) -> asyncio.Task[object]:
    """Begin to register, and wait until the master holds the call."""
    task = asyncio.ensure_future(register(node))
    while not master.held:
        await asyncio.sleep(0.01)
    return task


async def cancel(task: asyncio.Task[object]) -> None:
    task.cancel()
    await asyncio.wait([task])
    assert task.cancelled()


def names(core: Core) -> set[str]:
    return {str(name) for part in core.graph.system_state() for name, _ in part}


async def until_called(master: HoldingMaster, calls: list[str]) -> None:
    async with asyncio.timeout(20):
        while master.calls != calls:
            await asyncio.sleep(0.01)


async def test_publisher_outlives_a_cancelled_first_one(
    core: Core, make_node: MakeNode, master: HoldingMaster
) -> None:
    async with node_at(master) as node, make_node("b") as other, asyncio.timeout(60):
        first = await begin(KINDS["Publisher"], node, master)
        second = asyncio.ensure_future(node.advertise("/t", STRING))
        await asyncio.sleep(0)
        await cancel(first)
        master.release()
        publisher: Publisher = await second
        heard = await other.subscribe("/t", STRING)
        await publisher.wait_for_subscribers()
        publisher.publish(data="hello")
        assert (await anext(aiter(heard))).data == "hello"
        assert master.calls == ["registerPublisher"]


async def test_subscriber_outlives_a_cancelled_first_one(
    core: Core, make_node: MakeNode, master: HoldingMaster
) -> None:
    async with node_at(master) as node, make_node("b") as other, asyncio.timeout(60):
        publisher = await other.advertise("/t", STRING, latch=True)
        publisher.publish(data="hello")
        first = await begin(KINDS["Subscriber"], node, master)
        second = asyncio.ensure_future(node.subscribe("/t", STRING))
        await asyncio.sleep(0)
        await cancel(first)
        master.release()
        heard: Subscriber = await second
        assert (await anext(aiter(heard))).data == "hello"
        assert master.calls == ["registerSubscriber"]


@pytest.mark.parametrize("kind", ["Publisher", "Subscriber"])
async def test_refused_registration_fails_all_handles(core: Core, master: HoldingMaster, kind: str) -> None:
    async with node_at(master) as node, asyncio.timeout(60):
        master.refuses = True
        tasks = [await begin(KINDS[kind], node, master), asyncio.ensure_future(KINDS[kind](node))]
        await asyncio.sleep(0)
        master.release()
        outcomes = await asyncio.gather(*tasks, return_exceptions=True)
        assert [type(outcome) for outcome in outcomes] == [MasterRefusedError] * 2
        await until_called(master, [f"register{kind}", f"unregister{kind}"])
        master.refuses = False
        await KINDS[kind](node)
        assert "/t" in names(core)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("leaves", [False, True])
async def test_cancelled_registration_is_taken_back(
    core: Core, master: HoldingMaster, kind: str, leaves: bool
) -> None:
    """Also if the node leaves the graph at once."""
    async with asyncio.timeout(60):
        async with node_at(master) as node:
            await cancel(await begin(KINDS[kind], node, master))
            master.release()
            if not leaves:
                await until_called(master, [f"register{kind}", f"unregister{kind}"])
                assert "/t" not in names(core)
        await until_called(master, [f"register{kind}", f"unregister{kind}"])
        assert "/t" not in names(core)


@pytest.mark.parametrize("kind", KINDS)
async def test_close_that_the_master_missed_is_repeated(core: Core, master: HoldingMaster, kind: str) -> None:
    """Else others would look for the topic or service at this node for as long as that runs."""
    master.release()
    async with node_at(master) as node, asyncio.timeout(60):
        handle: Any = await KINDS[kind](node)
        master.failures = 1
        with pytest.raises(MasterUnreachableError):
            await handle.close()
        await until_called(master, [f"register{kind}", f"unregister{kind}"])
        assert "/t" not in names(core)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes wait for a tenth of a second for each answer of their master."""
    create = MasterClient.__init__
    monkeypatch.setattr(MasterClient, "__init__", partialmethod(create, timeout=0.1))


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("kind", KINDS)
async def test_busy_master_is_asked_again(core: Core, master: HoldingMaster, kind: str) -> None:
    """As one whose robot starts all its nodes at once: a node that gave up would be missing."""
    async with asyncio.timeout(60), node_at(master) as node:
        task = await begin(KINDS[kind], node, master)
        while master.held < 3:
            await asyncio.sleep(0.01)
        master.release()
        await task
        assert "/t" in names(core)
        assert f"unregister{kind}" not in master.calls


@pytest.mark.usefixtures("impatient")
async def test_master_that_is_busy_for_long_is_given_up(
    master: HoldingMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registrations, "BUSY_S", 0.5)
    async with asyncio.timeout(60), node_at(master) as node:
        with pytest.raises(MasterUnreachableError, match=r"took longer than 0\.1 s"):
            await node.advertise("/t", STRING)
        master.release()


async def test_call_on_its_way_is_answered_while_a_master_ends(core: Core) -> None:
    """By a core in the same event loop: one that waited there for the call's end would wait in vain."""
    master = HoldingMaster(core.uri, "/t")
    async with asyncio.timeout(60):
        async with serving(master) as uri:
            with ServerProxy(uri) as caller:
                arguments = ("/a", "/t", STRING, "http://127.0.0.1:1/")
                call = asyncio.create_task(asyncio.to_thread(caller.registerPublisher, *arguments))
                while not master.held:
                    await asyncio.sleep(0.01)
            master.release()
        await call
    assert master.calls == ["registerPublisher"]


@pytest.mark.usefixtures("impatient")
async def test_node_that_starts_waits_for_a_busy_master(core: Core) -> None:
    """Longer than for one that is not up, which its user would wait for in vain."""
    master = HoldingMaster(core.uri, "/use_sim_time", method="getParam")
    async with serving(master) as master.uri:
        node = Node(
            "a", argv=[], master_uri=master.uri, master_timeout=0.2, intra_process=False, signals=False
        )
        async with asyncio.timeout(60):
            start = asyncio.ensure_future(node.__aenter__())
            while master.held < 4:
                await asyncio.sleep(0.01)
            master.release()
            await start
            await node.__aexit__(None, None, None)


@pytest.mark.parametrize("kind", KINDS)
async def test_name_that_is_registered_again_stays(core: Core, master: HoldingMaster, kind: str) -> None:
    """What takes back the cancelled registration does not remove the next one."""
    async with node_at(master) as node, asyncio.timeout(60):
        await cancel(await begin(KINDS[kind], node, master))
        again = asyncio.ensure_future(KINDS[kind](node))
        await asyncio.sleep(0)
        master.release()
        await again
        assert "/t" in names(core)
        assert f"unregister{kind}" not in master.calls
