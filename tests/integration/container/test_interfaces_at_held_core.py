"""Interfaces of a container whose ROS core is held, or stopped, while they register."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from support.ros_masters import HoldingMaster, serving

from rce.link import InterfaceError
from rce.model.specs import InterfaceSpec
from rce.ros.core import Core
from rce.ros.node import Node
from rce_container.environment.interfaces import InterfaceMaker, Readiness

if TYPE_CHECKING:
    from collections.abc import Collection

    from rce.link import Buffer, Interface


class Port:
    """A port to no peer."""

    def __init__(self, spec: InterfaceSpec) -> None:
        self.spec = spec

    def send(self, payload: Buffer, *, latched: bool = False, source: str = "") -> None:
        raise AssertionError("nothing is published")

    def keep_latched(self, sources: Collection[str]) -> None:
        """Do nothing."""

    async def call(self, payload: Buffer, *, timeout: float | None = None) -> bytes:
        raise AssertionError("nothing is called")


SPECS = [
    InterfaceSpec(tag="i", type="PublisherInterface", message_type="std_msgs/String", addr="/held"),
    InterfaceSpec(tag="i", type="SubscriberInterface", message_type="std_msgs/String", addr="/held"),
    InterfaceSpec(tag="i", type="ServiceProviderInterface", message_type="std_srvs/Empty", addr="/held"),
]


def make(node: Node, spec: InterfaceSpec) -> Interface:
    return InterfaceMaker(node, node._types.registry, Readiness(lambda: False))(Port(spec))


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: spec.type)
async def test_interface_registers_when_the_core_answers_again(spec: InterfaceSpec) -> None:
    """It stayed closed until its spec changed: a robot had no poses from then on."""
    async with Core(port=0) as core, asyncio.timeout(120):
        master = HoldingMaster(core.uri, "/held")
        async with (
            serving(master) as uri,
            Node("environment", argv=[], master_uri=uri, signals=False) as node,
        ):
            node._running.master.timeout = 0.1
            interface = make(node, spec)
            start = asyncio.create_task(interface.start())
            try:
                while master.held < 2 and not start.done():
                    await asyncio.sleep(0.01)
                node._running.master.timeout = 60.0
            finally:
                master.release()
            await start
            state = core.graph.system_state()
            assert ["/held", ["/environment"]] in [entry for part in state for entry in part]
            await interface.close()


async def test_interface_that_the_core_refuses_does_not_start() -> None:
    async with Core(port=0) as core, asyncio.timeout(120):
        master = HoldingMaster(core.uri, "/held")
        master.refuses = True
        master.release()
        async with (
            serving(master) as uri,
            Node("environment", argv=[], master_uri=uri, signals=False) as node,
        ):
            interface = make(node, SPECS[0])
            with pytest.raises(InterfaceError, match="refused"):
                await interface.start()
            await interface.close()
