"""What waits for a task set that reads slowly, or not at all."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, cast

import pytest

from rce.aio.tasks import cancel_and_wait
from rce.control.messages import CONTROL_VERSION, Hello, MachineInfo, Notify, Sync, TaskSetKind
from rce.control.model import EndpointKind, EndpointSpec
from rce.control_channel import peer as peer_module
from rce.control_channel.peer import Peer
from rce.control_channel.timeouts import DEFAULT_TIMEOUTS

if TYPE_CHECKING:
    from collections.abc import Callable

    from websockets.asyncio.server import ServerConnection

LIMIT = 1 << 20
LONG = Notify(id="anna/rob", text="x" * (LIMIT // 10))


class Socket:
    """The master's end of a connection; what is sent stays in it until it is ``free``."""

    def __init__(self) -> None:
        self.free = asyncio.Event()
        self.sent: list[str] = []
        self.is_aborted = False
        self.transport = self

    def abort(self) -> None:
        self.is_aborted = True

    async def send(self, text: str) -> None:
        await self.free.wait()
        self.sent.append(text)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peer_module, "MAX_TEXT", LIMIT)


@pytest.fixture
def socket() -> Socket:
    return Socket()


def peer_of(socket: Socket, is_fenced: Callable[[], bool] | None = None) -> Peer:
    hello = Hello(
        version=CONTROL_VERSION,
        kind=TaskSetKind.CONTAINER,
        process="c1",
        machine=MachineInfo(name="m"),
    )
    return Peer(hello, cast("ServerConnection", socket), DEFAULT_TIMEOUTS, is_fenced)


@pytest.fixture
def peer(socket: Socket) -> Peer:
    return peer_of(socket)


async def test_a_peer_that_reads_nothing_is_cut_off(peer: Peer, socket: Socket) -> None:
    pumping = asyncio.create_task(peer.pump())
    for _ in range(200):
        peer.send(LONG)
        await asyncio.sleep(0)
    assert socket.is_aborted
    assert peer._outbox.qsize() <= 12
    await cancel_and_wait(pumping)


async def test_a_peer_that_reads_is_not_cut_off(peer: Peer, socket: Socket) -> None:
    socket.free.set()
    pumping = asyncio.create_task(peer.pump())
    for count in range(1, 31):
        peer.send(LONG)
        while len(socket.sent) < count:
            await asyncio.sleep(0)
    assert not socket.is_aborted
    await cancel_and_wait(pumping)


async def test_a_whole_state_may_be_longer(peer: Peer, socket: Socket) -> None:
    """The task set would be cut off at each attempt, else."""
    long = EndpointSpec(id=f"anna/{'c' * 2 * LIMIT}", kind=EndpointKind.CONTAINER, revision=1)
    peer.send(Sync(endpoints=(long,)))
    for _ in range(10):
        peer.send(LONG)
    assert not socket.is_aborted


async def test_a_master_that_lost_the_lead_sends_nothing(socket: Socket) -> None:
    socket.free.set()
    peer = peer_of(socket, is_fenced=lambda: True)
    peer.send(LONG)
    pumping = asyncio.create_task(peer.pump())
    for _ in range(10):
        await asyncio.sleep(0)
    assert socket.sent == []
    assert socket.is_aborted
    await cancel_and_wait(pumping)
