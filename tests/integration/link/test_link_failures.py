"""Links that break, are refused, or stall: nobody else is hurt, and all comes back."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace
from support.link_frames import hello, read_on
from support.link_kinds import SERVICE_OUT, TOPIC_OUT

from rce.control.model import ConnectionSpec, LinkAddress, LinkSpec
from rce.link import (
    CallTimeoutError,
    LinkLimits,
    LinkLostError,
    MessageTooLargeError,
    OverloadedError,
    PeerLostError,
)
from rce.link.frame_reader import FrameReader
from rce.link.frames import Frame, FrameType, encode
from rce.link.handshake import encode_hello, encode_welcome

if TYPE_CHECKING:
    from .conftest import Party, Rig


def kill_link(party: Party) -> None:
    """End the party's link as a crash of the network or the peer would."""
    link = party.endpoint._links["L"]
    assert link.carrier is not None
    if link.carrier.kind == "local":
        link.carrier.close()
        link.carrier_lost(link.carrier, LinkLostError("killed"))
    else:
        link.carrier.abort(LinkLostError("killed"))


@pytest.mark.parametrize("side", [0, 1])
async def test_killed_link_comes_back(rig: Rig, way: str, side: int) -> None:
    parties = a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT, SERVICE_OUT])
    await a.connected(1, 2)
    await b.connected(1, 2)

    async def hang(_: bytes) -> bytes:
        await asyncio.Event().wait()
        return b""

    b.fakes["i2"].answer = hang
    call = asyncio.ensure_future(a.fakes["i2"].port.call(b"never answered"))
    await b.fakes["i2"].asked.wait()
    kill_link(parties[side])
    with pytest.raises(PeerLostError):
        await call
    await a.until(lambda: a.fakes["i1"].active == [True, False, True])
    await b.until(lambda: b.fakes["i1"].active == [True, False, True])
    await a.connected(1, 2)
    assert b.fakes["i2"].serving == 0
    a.fakes["i1"].port.send(b"again")
    assert await b.fakes["i1"].received.get() == (b"again", False)


async def test_peer_that_restarts_elsewhere_is_found(rig: Rig) -> None:
    a, b = await rig.pair("unix")
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    spec = b.spec
    await b.endpoint.close()
    await a.connected()
    c = rig.party("b", await rig.hub())
    await rig.listen(c, "tcp")
    await c.endpoint.apply(spec)
    await a.apply(links=[replace(a.spec.links[0], address=c.address)])
    await a.connected(1)
    a.fakes["i1"].port.send(b"hi")
    assert await c.fakes["i1"].received.get() == (b"hi", False)


async def test_changed_address_is_dialed_at_once(rig: Rig) -> None:
    a, b = await rig.pair("unix")
    await rig.listen(b, "unix")
    second = b.address
    await rig.listen(b, "unix")
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    await a.apply(links=[replace(a.spec.links[0], address=second)])
    assert a.endpoint.connections == ()
    await a.connected(1)
    assert a.fakes["i1"].active == [True, False, True]


async def test_tcp_connection_outlives_a_changed_socket_path(rig: Rig) -> None:
    """A peer that was reached by TCP before its new socket's path was known is not left again."""
    a, b = await rig.pair("tcp")
    b.address = replace(b.address, machine="here", unix=str(rig.folder / "former"))
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    by_tcp = b.address
    await rig.listen(b, "unix")
    await a.apply(links=[replace(a.spec.links[0], address=replace(by_tcp, unix=b.address.unix))])
    a.fakes["i1"].port.send(b"hi")
    assert await b.fakes["i1"].received.get() == (b"hi", False)
    assert a.fakes["i1"].active == [True]


async def test_link_waits_for_its_address(rig: Rig) -> None:
    a, b = await rig.pair("unix")
    address, b.address = b.address, LinkAddress()
    await rig.join(a, b, [TOPIC_OUT])
    await a.apply(links=[replace(a.spec.links[0], address=address)])
    await a.connected(1)


async def test_tcp_is_taken_where_the_unix_socket_is_dead(rig: Rig) -> None:
    a, b = await rig.pair("tcp")
    b.address = replace(b.address, machine="here", unix=str(rig.folder / "nobody"))
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)


async def test_peer_may_come_first_or_last_to_the_same_process(rig: Rig) -> None:
    hub = await rig.hub()
    a, b = rig.party("a", hub), rig.party("b", hub)
    await rig.listen(b, "unix")
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    spec = b.spec
    await b.endpoint.close()
    await a.connected()
    c = rig.party("b", hub)
    await c.endpoint.apply(spec)
    await a.connected(1)
    assert a.endpoint._links["L"].carrier is not None
    assert a.endpoint._links["L"].carrier.kind == "local"


async def test_call_times_out_and_is_cancelled_at_the_peer(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [SERVICE_OUT])
    await a.connected(1)
    ended = asyncio.Event()

    async def wait(_: bytes) -> bytes:
        try:
            await asyncio.Event().wait()
        finally:
            ended.set()
        return b""

    b.fakes["i1"].answer = wait
    with pytest.raises(CallTimeoutError, match=r"0\.05 s"):
        await a.fakes["i1"].port.call(b"", timeout=0.05)
    await ended.wait()
    ended.clear()
    b.fakes["i1"].asked.clear()
    call = asyncio.ensure_future(a.fakes["i1"].port.call(b""))
    await b.fakes["i1"].asked.wait()
    call.cancel()
    await ended.wait()
    b.fakes["i1"].answer = b.fakes["i1"].upper
    assert await a.fakes["i1"].port.call(b"fine") == b"FINE"


async def test_overloaded_peer_says_so(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way, LinkLimits(serving=1, waiting=1, max_calls=4))
    await rig.join(a, b, [SERVICE_OUT])
    await a.connected(1)
    release = asyncio.Event()

    async def wait(payload: bytes) -> bytes:
        await release.wait()
        return payload

    b.fakes["i1"].answer = wait
    port = a.fakes["i1"].port
    served = [asyncio.ensure_future(port.call(b"%d" % n)) for n in range(2)]
    await asyncio.sleep(0)
    with pytest.raises(OverloadedError):
        await port.call(b"one too many at the peer")
    release.set()
    assert await asyncio.gather(*served) == [b"0", b"1"]
    release.clear()
    results = await asyncio.gather(*(_timed(port.call(b"x", timeout=0.05)) for _ in range(6)))
    assert results.count("OverloadedError") >= 4


async def _timed(call: Awaitable[object]) -> str:
    try:
        await call
    except (CallTimeoutError, OverloadedError) as error:
        return type(error).__name__
    return "answered"


async def test_too_large_messages(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way, LinkLimits(max_message=1_000))
    await rig.join(a, b, [TOPIC_OUT, SERVICE_OUT])
    await a.connected(1, 2)
    for _ in range(3):
        a.fakes["i1"].port.send(bytes(1_001))
    a.fakes["i1"].port.send(bytes(1_000))
    assert await b.fakes["i1"].received.get() == (bytes(1_000), False)
    assert a.faults == ["interface i1: message of 1001 bytes is larger than the limit of 1000 bytes"]
    assert a.endpoint.usage()["i1"].dropped == 3
    with pytest.raises(MessageTooLargeError):
        await a.fakes["i2"].port.call(bytes(1_001))

    async def too_much(_: bytes) -> bytes:
        return bytes(1_001)

    b.fakes["i2"].answer = too_much
    with pytest.raises(Exception, match="larger than the limit"):
        await a.fakes["i2"].port.call(b"")


class Stalled:
    """A peer that shakes hands, opens its channels and then reads no more."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock

    @classmethod
    async def dial(cls, address: LinkAddress, link: str, channels: list[int]) -> Stalled:
        loop = asyncio.get_running_loop()
        sock = socket.socket(socket.AF_UNIX)
        sock.setblocking(False)
        await loop.sock_connect(sock, address.unix)
        await loop.sock_sendall(sock, encode_hello(link, "secret"))
        await loop.sock_recv(sock, len(encode_welcome()))
        await loop.sock_sendall(sock, b"".join(encode(Frame(FrameType.OPEN, n)) for n in channels))
        return cls(sock)

    async def read_frames(self, reader: FrameReader) -> list[Frame]:
        return reader.feed(await asyncio.get_running_loop().sock_recv(self.sock, 65_536))


async def stalled_and_healthy(rig: Rig) -> tuple[Party, Party, Stalled]:
    """One robot sends i1 and i2 to a stalled peer and i3 to a healthy one."""
    robot, healthy = await rig.pair("unix", LinkLimits(queue_messages=8, queue_bytes=12_000_000))
    await rig.listen(robot, "unix")
    await robot.apply(
        {f"i{n}": "SubscriberInterface" for n in (1, 2, 3)},
        [
            LinkSpec(id="S", peer="user/s", token="secret", dial=False),
            LinkSpec(id="L", peer="user/b", token="secret", dial=True, address=healthy.address),
        ],
        [
            ConnectionSpec(id=n, link="L" if n == 3 else "S", interface=f"i{n}", peer_interface="x")
            for n in (1, 2, 3)
        ],
    )
    await healthy.apply(
        {"i3": "PublisherConverter"},
        [LinkSpec(id="L", peer="user/a", token="secret", dial=False)],
        [ConnectionSpec(id=3, link="L", interface="i3", peer_interface="i3")],
    )
    stalled = await Stalled.dial(robot.address, "S", [1, 2])
    await robot.connected(1, 2, 3)
    return robot, healthy, stalled


async def test_stalled_peer_loses_its_own_old_messages_only(rig: Rig) -> None:
    robot, healthy, stalled = await stalled_and_healthy(rig)
    image = bytes(5_000_000)
    for n in range(60):
        robot.fakes["i1"].port.send(image)
        robot.fakes["i2"].port.send(b"pose %d" % n)
        robot.fakes["i3"].port.send(image)
        assert len((await healthy.fakes["i3"].received.get())[0]) == len(image)
    usage = robot.endpoint.usage()
    assert usage["i3"].dropped == 0
    assert usage["i1"].dropped >= 56
    assert usage["i2"].dropped >= 50
    queues = [channel._queue for channel in robot.endpoint._channels]
    assert sum(queue.waiting_bytes for queue in queues) <= 17_001_000
    stalled.sock.close()
    await robot.connected(3)
    assert sum(channel._queue.waiting_bytes for channel in robot.endpoint._channels) == 0


async def test_small_messages_overtake_a_large_one(rig: Rig) -> None:
    robot, _, stalled = await stalled_and_healthy(rig)
    robot.fakes["i1"].port.send(bytes(10_000_000))
    for n in range(5):
        robot.fakes["i2"].port.send(b"urgent %d" % n)
    reader = FrameReader(LinkLimits())
    messages: list[bytes] = []
    while len(messages) < 5:
        messages += [bytes(f.payload) for f in await stalled.read_frames(reader) if f.type is FrameType.DATA]
    assert messages == [b"urgent %d" % n for n in range(5)]
    (queue,) = (channel._queue for channel in robot.endpoint._channels.of(1))
    assert queue.sent < 2_000_000
    while len(messages) < 6:
        messages += [bytes(f.payload) for f in await stalled.read_frames(reader) if f.type is FrameType.DATA]
    stalled.sock.close()
    assert len(messages[5]) == 10_000_000


async def test_rest_of_a_call_that_timed_out_is_not_sent(rig: Rig) -> None:
    """What a slow peer has got of it is dropped, so that it is not carried out; the next call follows."""
    robot = rig.party("a", await rig.hub())
    await rig.listen(robot, "unix")
    await robot.apply(
        {"i1": SERVICE_OUT[0]},
        [LinkSpec(id="S", peer="user/s", token="secret", dial=False)],
        [ConnectionSpec(id=1, link="S", interface="i1", peer_interface="x")],
    )
    slow = await Stalled.dial(robot.address, "S", [1])
    await robot.connected(1)
    port = robot.fakes["i1"].port
    with pytest.raises(CallTimeoutError):
        await port.call(bytes(10_000_000), timeout=0.1)
    call = asyncio.ensure_future(port.call(b"next", timeout=60.0))
    reader = FrameReader(LinkLimits())
    calls: list[Frame] = []
    while not calls:
        calls += [frame for frame in await slow.read_frames(reader) if frame.type is FrameType.CALL]
    assert [bytes(frame.payload) for frame in calls] == [b"next"]
    answer = encode(Frame(FrameType.REPLY, 1, calls[0].id, 0, b"answer"))
    await asyncio.get_running_loop().sock_sendall(slow.sock, answer)
    assert await call == b"answer"
    assert [channel.waiting_bytes for channel in robot.endpoint._channels.of(1)] == [0]
    slow.sock.close()


async def test_dead_machine_is_noticed_on_tcp(rig: Rig) -> None:
    b = rig.party("b", await rig.hub(heartbeat=0.05, silence=0.2))
    await rig.listen(b, "tcp")
    await b.apply(
        {"i1": "PublisherInterface"},
        [LinkSpec(id="L", peer="user/a", token="secret", dial=False)],
        [ConnectionSpec(id=1, link="L", interface="i1", peer_interface="x")],
    )
    reader, writer = await hello(b.address, encode_hello("L", "secret") + encode(Frame(FrameType.OPEN, 1)))
    await b.connected(1)
    await b.connected()
    assert encode(Frame(FrameType.PING)) in await read_on(reader)
    writer.close()


async def test_living_silent_peer_is_kept_on_tcp(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = await rig.pair("tcp", heartbeat=0.02, silence=0.2)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    carrier = a.endpoint._links["L"].carrier
    assert carrier is not None
    pings = 0
    enough = asyncio.Event()
    control = carrier.control

    def count(frame: Frame) -> None:
        nonlocal pings
        pings += frame.type is FrameType.PING
        if pings == 15:
            enough.set()
        control(frame)

    monkeypatch.setattr(carrier, "control", count)
    await enough.wait()
    assert a.fakes["i1"].active == [True]
