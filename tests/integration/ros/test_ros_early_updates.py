"""A master that reports publishers before it answers a registration, and in another order."""

from __future__ import annotations

import asyncio
import time
import xmlrpc.client
from typing import Any

import pytest
from support.ros_masters import serving
from support.ros_nodes import MakeNode

from rce.ros.core import Core
from rce.ros.errors import MasterRefusedError
from rce.ros.node import Node, Publisher

STRING = "std_msgs/String"


class EarlyMaster:
    """Passes calls on to a core; the node hears of the publishers of ``/t`` before the answer.

    Args:
        core_uri: The core.
        early: How many publishers the update names.
        late: How many the answer names.
        times: How often an update comes early.
    """

    def __init__(self, core_uri: str, early: int, late: int, times: int) -> None:
        self.registrations = 0
        self._core_uri = core_uri
        self._early = early
        self._late = late
        self._times = times

    def _dispatch(self, method: str, arguments: tuple[Any, ...]) -> Any:
        with xmlrpc.client.ServerProxy(self._core_uri) as core:
            answer: Any = getattr(core, method)(*arguments)
        if method != "registerSubscriber" or arguments[1] != "/t":
            return answer
        self.registrations += 1
        if self.registrations > self._times:
            return answer
        status, text, publishers = answer
        with xmlrpc.client.ServerProxy(arguments[3]) as node:
            node.publisherUpdate("/master", "/t", publishers[: self._early])
        return status, text, publishers[: self._late]


@pytest.mark.parametrize(("early", "late", "most"), [(2, 1, 3), (2, 2, 1)])
async def test_update_before_the_answer_is_not_lost(
    core: Core, make_node: MakeNode, early: int, late: int, most: int
) -> None:
    async with make_node("a") as a, make_node("b") as b, asyncio.timeout(60):
        publishers = [await node.advertise("/t", STRING) for node in (a, b)]
        master = EarlyMaster(core.uri, early, late, times=100)
        async with (
            serving(master) as uri,
            Node("c", argv=[], master_uri=uri, intra_process=False, signals=False) as listener,
        ):
            await listener.subscribe("/t", STRING)
            assert master.registrations <= most
            for publisher in publishers:
                await publisher.wait_for_subscribers()
            await listener.reregister()
            assert [publisher.connections for publisher in publishers] == [1, 1]


async def test_update_of_before_the_registration_is_asked_about(core: Core, make_node: MakeNode) -> None:
    """It was meant for a subscription that this node has given up: the answer is newer."""
    async with make_node("a") as a, make_node("b") as b, asyncio.timeout(60):
        publishers = [await node.advertise("/t", STRING) for node in (a, b)]
        master = EarlyMaster(core.uri, early=1, late=2, times=1)
        async with (
            serving(master) as uri,
            Node("c", argv=[], master_uri=uri, intra_process=False, signals=False) as listener,
        ):
            await listener.subscribe("/t", STRING)
            for publisher in publishers:
                await publisher.wait_for_subscribers()


class RefusingMaster(EarlyMaster):
    """Refuses the subscription once the node has connected to the publisher."""

    def __init__(self, core_uri: str, publisher: Publisher) -> None:
        super().__init__(core_uri, early=1, late=1, times=1)
        self._publisher = publisher

    def _dispatch(self, method: str, arguments: tuple[Any, ...]) -> Any:
        answer = super()._dispatch(method, arguments)
        if method != "registerSubscriber":
            return answer
        while not self._publisher.connections:
            time.sleep(0.01)
        return -1, "refused", 0


async def test_refused_registration_leaves_no_connection(core: Core, make_node: MakeNode) -> None:
    async with make_node("a") as a, asyncio.timeout(60):
        publisher = await a.advertise("/t", STRING)
        async with (
            serving(RefusingMaster(core.uri, publisher)) as uri,
            Node("c", argv=[], master_uri=uri, intra_process=False, signals=False) as listener,
        ):
            with pytest.raises(MasterRefusedError):
                await listener.subscribe("/t", STRING)
            while publisher.connections:
                await asyncio.sleep(0.01)
