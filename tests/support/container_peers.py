"""Robots that are wired to a container, for a test to play on."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

from rce.control.model import (
    EndpointKind,
    EndpointSpec,
    LinkAddress,
)
from rce.link import Buffer, Endpoint, Interface, LinkHub, Port
from rce.model.names import EndpointId
from rce.model.specs import InterfaceSpec
from support.container_specs import ECHO_INTERFACES, MACHINE, wiring


class PeerEnd(Interface):
    """A peer's end of a connection, for a test to play on."""

    def __init__(self, port: Port) -> None:
        super().__init__(port)
        self.active = asyncio.Event()
        self.history: list[bool] = []
        self.received: asyncio.Queue[bytes] = asyncio.Queue()

    async def start(self) -> None: ...

    async def close(self) -> None: ...

    def on_active(self, active: bool) -> None:
        self.history.append(active)
        self.active.set() if active else self.active.clear()

    def receive(self, payload: bytes, *, latched: bool) -> None:
        self.received.put_nowait(payload)

    async def serve(self, payload: bytes) -> Buffer:
        return payload


COMPLEMENT = {
    "PublisherInterface": "SubscriberForwarder",
    "SubscriberInterface": "PublisherForwarder",
    "ServiceClientInterface": "ServiceProviderForwarder",
    "ServiceProviderInterface": "ServiceClientForwarder",
}


class Peer:
    """A robot that is wired to a container."""

    def __init__(self, machine: str) -> None:
        self.hub = LinkHub(machine)
        self.ends: dict[str, PeerEnd] = {}
        self.faults: list[str] = []
        self.endpoint = Endpoint(
            EndpointId.parse("user/robot"),
            self._make,
            self.hub,
            on_change=lambda: None,
            on_fault=self.faults.append,
        )

    def _make(self, port: Port) -> PeerEnd:
        end = self.ends[port.spec.tag] = PeerEnd(port)
        return end

    async def wire(
        self,
        address: LinkAddress,
        interfaces: tuple[InterfaceSpec, ...],
        revision: int = 1,
        id_: str = "user/box",
    ) -> None:
        """Connect to a container's interfaces."""
        own = tuple(
            InterfaceSpec(tag=i.tag, type=COMPLEMENT[i.type], message_type=i.message_type) for i in interfaces
        )
        links, connections = wiring(id_, address, [i.tag for i in interfaces])
        await self.endpoint.apply(
            EndpointSpec(
                id="user/robot",
                kind=EndpointKind.ROBOT,
                revision=revision,
                interfaces=own,
                links=links,
                connections=connections,
            )
        )

    async def active(self, *tags: str) -> None:
        async with asyncio.timeout(60):
            for tag in tags or self.ends:
                await self.ends[tag].active.wait()

    async def close(self) -> None:
        await self.endpoint.close()
        await self.hub.close()


@contextlib.asynccontextmanager
async def joined(address: LinkAddress, machine: str = MACHINE) -> AsyncIterator[Peer]:
    peer = Peer(machine)
    try:
        await peer.wire(address, ECHO_INTERFACES)
        yield peer
    finally:
        await peer.close()
