"""Two or more endpoints in one process, joined in every way that links know."""

from __future__ import annotations

import asyncio
import shutil
import socket
import tempfile
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support.patches import patch_between

from rce.aio.backoff import Backoff
from rce.control.model import ConnectionSpec, EndpointKind, EndpointSpec, LinkAddress, LinkSpec
from rce.link import (
    Buffer,
    Endpoint,
    Interface,
    InterfaceError,
    LinkHub,
    LinkLimits,
    LinkTimeouts,
    PeerFaultError,
    Port,
)
from rce.link.handover import HandoverReceiver, HandoverSender, LinkAcceptor
from rce.model.names import EndpointId
from rce.model.specs import InterfaceSpec

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Iterator


WAYS = ("local", "unix", "tcp", "handed-over", "secure", "handed-over-secure")
TIMEOUTS = LinkTimeouts(redial=Backoff(0.005, 0.05, jitter=0.5), unknown_link=0.5, flush=0.2, close=1.0)


class FakeInterface(Interface):
    """Notes what it is told; answers requests as its ``answer`` says."""

    def __init__(self, port: Port) -> None:
        super().__init__(port)
        self.received: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        self.latched: dict[str, bytes] = {}
        self.unlatched = asyncio.Event()
        self.active: list[bool] = []
        self.may_start = asyncio.Event()
        self.may_start.set()
        self.may_close = asyncio.Event()
        self.may_close.set()
        self.closed = False
        self.serving = 0
        self.asked = asyncio.Event()
        self.answer: Callable[[bytes], Awaitable[Buffer]] = self.upper

    async def start(self) -> None:
        if self.port.spec.addr == "/slow":
            self.may_start.clear()
        if self.port.spec.addr == "/bad":
            raise InterfaceError("cannot start")
        await self.may_start.wait()

    async def close(self) -> None:
        assert not self.closed
        self.closed = True
        await self.may_close.wait()

    def receive(self, payload: bytes, *, latched: bool) -> None:
        assert type(payload) is bytes
        if payload == b"refuse me":
            raise ValueError("refused")
        self.received.put_nowait((payload, latched))

    def receive_latched(self, payload: bytes, source: str) -> None:
        self.latched[source] = payload
        super().receive_latched(payload, source)

    def unlatch(self, sources: Collection[str]) -> None:
        for source in sources:
            del self.latched[source]
        self.unlatched.set()

    async def until_latched(self, *payloads: bytes) -> None:
        """Wait until exactly these messages are in force."""
        async with asyncio.timeout(60):
            while sorted(self.latched.values()) != sorted(payloads):
                self.unlatched.clear()
                waits = [
                    asyncio.ensure_future(self.unlatched.wait()),
                    asyncio.ensure_future(self.received.get()),
                ]
                await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
                for wait in waits:
                    wait.cancel()

    async def upper(self, payload: bytes) -> bytes:
        if payload == b"fail":
            raise PeerFaultError("told to fail")
        return payload.upper()

    async def serve(self, payload: bytes) -> Buffer:
        self.serving += 1
        self.asked.set()
        try:
            return await self.answer(payload)
        finally:
            self.serving -= 1

    def on_active(self, active: bool) -> None:
        self.active.append(active)


class Party:
    """An endpoint with its hub, and what it was told."""

    def __init__(self, name: str, hub: LinkHub) -> None:
        self.hub = hub
        self.fakes: dict[str, FakeInterface] = {}
        self.faults: list[str] = []
        self.changed = asyncio.Event()
        self.spec = EndpointSpec(id=f"user/{name}", kind=EndpointKind.ROBOT, revision=0)
        self.endpoint = Endpoint(
            EndpointId("user", name),
            self._make,
            hub,
            on_change=self.changed.set,
            on_fault=self._fault,
        )
        self.address = LinkAddress()
        self.in_patches = False
        """Whether what it applies is told as patches."""

    def _make(self, port: Port) -> Interface:
        if port.spec.addr == "/unmakable":
            raise InterfaceError("cannot be made")
        fake = self.fakes[port.spec.tag] = FakeInterface(port)
        return fake

    def _fault(self, text: str) -> None:
        self.faults.append(text)
        self.changed.set()

    async def apply(
        self,
        interfaces: dict[str, str] | None = None,
        links: list[LinkSpec] | None = None,
        connections: list[ConnectionSpec] | None = None,
        addr: str = "",
    ) -> None:
        """Apply a spec; ``interfaces`` is tag to type; what is None stays."""
        old = self.spec
        self.spec = EndpointSpec(
            id=old.id,
            kind=old.kind,
            revision=old.revision + 1,
            interfaces=old.interfaces
            if interfaces is None
            else tuple(
                InterfaceSpec(tag=t, type=k, message_type="test/Any", addr=addr)
                for t, k in interfaces.items()
            ),
            links=old.links if links is None else tuple(links),
            connections=old.connections if connections is None else tuple(connections),
            resources=old.resources,
        )
        if self.in_patches:
            await self.endpoint.patch(patch_between(old, self.spec))
        else:
            await self.endpoint.apply(self.spec)

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait for a change that makes ``condition`` true."""
        async with asyncio.timeout(60):
            while not condition():
                self.changed.clear()
                await self.changed.wait()

    async def connected(self, *numbers: int) -> None:
        await self.until(lambda: self.endpoint.connections == numbers)


class Rig:
    """Makes parties and joins them."""

    def __init__(self, stack: AsyncExitStack, folder: Path) -> None:
        self.stack = stack
        self.folder = folder
        self.count = 0

    async def hub(
        self, machine: str = "here", limits: LinkLimits | None = None, **timeouts: float
    ) -> LinkHub:
        settings = {f: getattr(TIMEOUTS, f) for f in LinkTimeouts.__slots__} | timeouts
        hub = LinkHub(machine, LinkTimeouts(**settings), limits)
        self.stack.push_async_callback(hub.close)
        return hub

    def party(self, name: str, hub: LinkHub) -> Party:
        party = Party(name, hub)
        self.stack.push_async_callback(party.endpoint.close)
        return party

    def path(self) -> Path:
        self.count += 1
        return self.folder / f"s{self.count}"

    async def listen(self, party: Party, way: str) -> None:
        """Make ``party`` reachable in one way."""
        hub = party.hub
        if way == "unix":
            path = self.path()
            await hub.listen_unix(path)
            party.address = LinkAddress(machine=hub.machine, unix=str(path))
        elif way == "tcp":
            port = await hub.listen_tcp("127.0.0.1", 0)
            party.address = LinkAddress(machine="", host="127.0.0.1", port=port)
        elif way == "secure":
            port = await hub.listen_secure("127.0.0.1", 0)
            party.address = LinkAddress(machine="", host="127.0.0.1", port=port, tls=True)
        elif way in ("handed-over", "handed-over-secure"):
            tls = way == "handed-over-secure"
            port = await self.acceptor(hub, ["L"], tls=tls)
            party.address = LinkAddress(machine="", host="127.0.0.1", port=port, tls=tls)

    async def acceptor(self, hub: LinkHub, links: list[str], *, tls: bool = False) -> int:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        sender = HandoverSender(ours)
        self.stack.callback(sender.close)
        receiver = HandoverReceiver(theirs, hub.adopt)
        self.stack.push_async_callback(receiver.close)
        acceptor = LinkAcceptor(TIMEOUTS, tls=tls)
        self.stack.push_async_callback(acceptor.close)
        await acceptor.assign(sender, links)
        return await acceptor.listen("127.0.0.1", 0)

    async def pair(
        self, way: str, limits: LinkLimits | None = None, **timeouts: float
    ) -> tuple[Party, Party]:
        """Make two parties; the first dials the second in the given way."""
        one = await self.hub("here", limits, **timeouts)
        other = one if way == "local" else await self.hub("here", limits, **timeouts)
        dialing, accepting = self.party("a", one), self.party("b", other)
        await self.listen(accepting, way)
        return dialing, accepting

    async def join(
        self,
        dialing: Party,
        accepting: Party,
        ends: list[tuple[str, str]],
        *,
        link: str = "L",
        addr: str = "",
    ) -> None:
        """Connect interface ``i1`` of both, and so on; ``ends`` are types at both ends."""
        for side, (party, dial) in enumerate(((dialing, True), (accepting, False))):
            peer = accepting if dial else dialing
            await party.apply(
                {f"i{n}": types[side] for n, types in enumerate(ends, 1)},
                [
                    LinkSpec(
                        id=link,
                        peer=peer.spec.id,
                        token="secret",
                        dial=dial,
                        address=accepting.address if dial else LinkAddress(),
                    )
                ],
                [
                    ConnectionSpec(id=n, link=link, interface=f"i{n}", peer_interface=f"i{n}")
                    for n in range(1, len(ends) + 1)
                ],
                addr,
            )


@asynccontextmanager
async def _no_leaks() -> AsyncIterator[None]:
    before = asyncio.all_tasks()
    yield
    await asyncio.sleep(0)
    assert asyncio.all_tasks() - before - {asyncio.current_task()} == set()


@pytest.fixture
def folder() -> Iterator[Path]:
    path = Path(tempfile.mkdtemp(prefix="rl", dir="/tmp"))
    yield path
    assert list(path.iterdir()) == []
    shutil.rmtree(path)


@pytest.fixture
async def rig(folder: Path) -> AsyncIterator[Rig]:
    async with _no_leaks(), AsyncExitStack() as stack:
        yield Rig(stack, folder)


@pytest.fixture(params=WAYS)
def way(request: pytest.FixtureRequest) -> str:
    return str(request.param)
