"""A limited endpoint on real sockets: both directions, all links together, live changes, urgency."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import msgspec
import pytest

from rce.control.model import ConnectionSpec, LinkSpec
from rce.link.frames import Frame, FrameType, encode
from rce.link.socket_carrier import SocketCarrier
from rce.model.specs import Resources

if TYPE_CHECKING:
    from integration.link.conftest import Party, Rig

RATE = 1_000_000
ENDS = [("SubscriberInterface", "PublisherConverter"), ("SubscriberInterface", "PublisherConverter")]
BACK = [("PublisherConverter", "SubscriberInterface"), ("PublisherConverter", "SubscriberInterface")]
SOCKETS = pytest.mark.parametrize("way", ["unix", "tcp", "handed-over"])
DIRECTIONS = pytest.mark.parametrize("outward", [True, False], ids=["out", "in"])


async def limit(party: Party, rate: int) -> None:
    party.spec = msgspec.structs.replace(
        party.spec, revision=party.spec.revision + 1, resources=Resources(bandwidth=rate)
    )
    await party.endpoint.apply(party.spec)


async def joined(rig: Rig, way: str, *, outward: bool, rate: int) -> tuple[Party, Party, Party]:
    """The limited party, the one that sends and the one that receives."""
    a, b = await rig.pair(way)
    limited = a if outward else b
    await limit(limited, rate)
    await rig.join(a, b, ENDS)
    await a.connected(1, 2)
    await b.connected(1, 2)
    return limited, a, b


def now() -> float:
    return asyncio.get_running_loop().time()


@SOCKETS
@DIRECTIONS
async def test_rate_holds_for_messages_larger_than_the_burst(rig: Rig, way: str, outward: bool) -> None:
    limited, a, b = await joined(rig, way, outward=outward, rate=RATE)
    start = now()
    for _ in range(3):
        a.fakes["i1"].port.send(bytes(400_000))
    for _ in range(3):
        assert len((await b.fakes["i1"].received.get())[0]) == 400_000
    assert 0.6 < now() - start < 10
    moved = limited.endpoint.traffic[1 if outward else 0]
    assert 1_200_000 < moved < 1_300_000, "headers are counted, and little else is sent"


@SOCKETS
@DIRECTIONS
async def test_small_message_passes_a_saturated_link(rig: Rig, way: str, outward: bool) -> None:
    _, a, b = await joined(rig, way, outward=outward, rate=50_000)
    for _ in range(3):
        a.fakes["i1"].port.send(bytes(10_000_000))
    for n in range(10):
        a.fakes["i2"].port.send(b"cancel %d" % n)
        async with asyncio.timeout(60):
            assert (await b.fakes["i2"].received.get())[0] == b"cancel %d" % n
    assert b.fakes["i1"].received.empty()


@SOCKETS
@DIRECTIONS
async def test_limit_changes_while_it_is_reached(rig: Rig, way: str, outward: bool) -> None:
    limited, a, b = await joined(rig, way, outward=outward, rate=5_000)
    for _ in range(3):
        a.fakes["i1"].port.send(bytes(10_000_000))
    a.fakes["i2"].port.send(b"small")
    await b.fakes["i2"].received.get()
    assert b.fakes["i1"].received.empty()
    await limit(limited, 200 * RATE)
    assert len((await b.fakes["i1"].received.get())[0]) == 10_000_000
    await limit(limited, 0)
    for _ in range(2):
        await b.fakes["i1"].received.get()
    for party in (a, b):
        carrier = party.endpoint._links["L"].carrier
        assert isinstance(carrier, SocketCarrier)
        a.fakes["i1"].port.send(b"settled")
        await b.fakes["i1"].received.get()
        assert carrier._flow is None, "without a limit nobody asks for one"


async def test_limit_that_is_reached_drops_the_senders_own_oldest(rig: Rig) -> None:
    _, a, b = await joined(rig, "unix", outward=False, rate=RATE)
    for n in range(200):
        a.fakes["i1"].port.send(bytes([n]) * 10_000)
    last = b""
    while not last.startswith(b"\xc7"):
        last = (await b.fakes["i1"].received.get())[0]
    assert a.endpoint.usage()["i1"].dropped > 50
    assert b.endpoint.usage()["i1"].dropped == 0


async def test_all_links_share_the_limit(rig: Rig) -> None:
    hub = await rig.hub()
    limited = rig.party("a", hub)
    peers = []
    for name in "bcd":
        peer = rig.party(name, await rig.hub())
        await rig.listen(peer, "unix")
        await peer.apply(
            {"i": "PublisherConverter"},
            [LinkSpec(id=name, peer="user/a", token="t", dial=False)],
            [ConnectionSpec(id=ord(name), link=name, interface="i", peer_interface="i")],
        )
        peers.append(peer)
    await limited.apply(
        {"i": "SubscriberInterface"},
        [
            LinkSpec(id=n, peer=f"user/{n}", token="t", dial=True, address=p.address)
            for n, p in zip("bcd", peers, strict=True)
        ],
        [ConnectionSpec(id=ord(n), link=n, interface="i", peer_interface="i") for n in "bcd"],
    )
    await limited.connected(*map(ord, "bcd"))
    await limit(limited, RATE)
    start = now()
    limited.fakes["i"].port.send(bytes(400_000))
    for peer in peers:
        await peer.fakes["i"].received.get()
    assert 0.6 < now() - start < 10


async def test_services_pass_a_limit(rig: Rig) -> None:
    a, b = await rig.pair("unix")
    await rig.join(a, b, [("ServiceProviderConverter", "ServiceClientInterface")])
    await a.connected(1)
    await limit(b, 2 * RATE)
    await limit(a, 2 * RATE)
    assert await a.fakes["i1"].port.call(bytes(300_000)) == bytes(300_000).upper()


async def test_limited_link_lives_though_little_may_pass(rig: Rig) -> None:
    a, b = await rig.pair("tcp", heartbeat=0.05, silence=0.3)
    await rig.join(a, b, ENDS)
    await a.connected(1, 2)
    await limit(b, 50_000)
    for _ in range(5):
        a.fakes["i1"].port.send(bytes(60_000))
    for _ in range(2):
        await b.fakes["i1"].received.get()
    assert a.endpoint.connections == b.endpoint.connections == (1, 2)


async def test_bad_grant_ends_the_link(rig: Rig) -> None:
    a, b = await rig.pair("unix")
    await rig.join(a, b, ENDS)
    await a.connected(1, 2)
    carrier = a.endpoint._links["L"].carrier
    assert isinstance(carrier, SocketCarrier)
    assert carrier._transport is not None
    carrier._transport.write(encode(Frame(FrameType.GRANT, payload=b"?")))
    await carrier.wait_closed()
    await a.connected(1, 2)
