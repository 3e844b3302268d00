"""Every pairing of interfaces, over every kind of link."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from rce.link import NotConnectedError, PeerFaultError

if TYPE_CHECKING:
    from .conftest import Rig

TOPIC_OUT = ("SubscriberConverter", "PublisherInterface")
TOPIC_IN = ("PublisherConverter", "SubscriberInterface")
SERVICE_OUT = ("ServiceProviderForwarder", "ServiceClientInterface")
SERVICE_IN = ("ServiceClientForwarder", "ServiceProviderInterface")


async def test_topics_in_both_directions(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT, TOPIC_IN])
    await a.connected(1, 2)
    await b.connected(1, 2)
    for size in (0, 1, 100, 5_000, 20_000, 131_072, 131_073, 1_000_000):
        payload = bytes(range(256)) * (size // 256) + bytes(size % 256)
        a.fakes["i1"].port.send(payload)
        assert await b.fakes["i1"].received.get() == (payload, False)
        b.fakes["i2"].port.send(memoryview(payload))
        assert await a.fakes["i2"].received.get() == (payload, False)
    assert a.fakes["i1"].active == b.fakes["i2"].active == [True]
    assert a.endpoint.interfaces == {"i1": True, "i2": True}
    usage = a.endpoint.usage()
    assert usage["i1"].messages_out == usage["i2"].messages_in == 8
    assert usage["i1"].bytes_out == usage["i2"].bytes_in == 1_287_246
    assert usage["i1"].dropped == 0


async def test_services_in_both_directions(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [SERVICE_OUT, SERVICE_IN])
    await a.connected(1, 2)
    await b.connected(1, 2)
    big = b"x" * 3_000_000
    assert await a.fakes["i1"].port.call(b"hello") == b"HELLO"
    assert await b.fakes["i2"].port.call(b"there") == b"THERE"
    assert await a.fakes["i1"].port.call(big) == big.upper()
    with pytest.raises(PeerFaultError, match="told to fail"):
        await a.fakes["i1"].port.call(b"fail")
    answers = await asyncio.gather(*(a.fakes["i1"].port.call(f"n{n}".encode()) for n in range(200)))
    assert answers == [f"N{n}".encode() for n in range(200)]


async def test_answers_come_in_any_order(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [SERVICE_OUT])
    await a.connected(1)
    release = {name: asyncio.Event() for name in (b"first", b"second")}

    async def wait(payload: bytes) -> bytes:
        await release[payload].wait()
        return payload

    b.fakes["i1"].answer = wait
    first = asyncio.ensure_future(a.fakes["i1"].port.call(b"first"))
    second = asyncio.ensure_future(a.fakes["i1"].port.call(b"second"))
    release[b"second"].set()
    assert await second == b"second"
    assert not first.done()
    release[b"first"].set()
    assert await first == b"first"


async def test_messages_keep_their_order(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    sent = [bytes([n]) * size for n, size in enumerate([10, 300_000, 5, 20_000, 1, 9_000, 4096, 4097] * 4)]
    for payload in sent:
        a.fakes["i1"].port.send(payload)
    got = [(await b.fakes["i1"].received.get())[0] for _ in sent]
    assert got == sent


async def test_latched_message_reaches_who_comes_late(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    a.fakes["i1"].port.send(b"map 1", latched=True)
    a.fakes["i1"].port.send(b"map 2", latched=True)
    assert await b.fakes["i1"].received.get() == (b"map 1", True)
    assert await b.fakes["i1"].received.get() == (b"map 2", True)
    connections = list(b.spec.connections)
    await b.apply(connections=[])
    await a.connected()
    await b.apply(connections=connections)
    assert await b.fakes["i1"].received.get() == (b"map 2", True)
    assert a.fakes["i1"].active == [True, False, True]


async def test_misuse_of_a_port(rig: Rig) -> None:
    a, b = await rig.pair("local")
    await rig.join(a, b, [TOPIC_OUT, SERVICE_OUT])
    with pytest.raises(TypeError):
        await a.fakes["i1"].port.call(b"")
    with pytest.raises(TypeError):
        a.fakes["i2"].port.send(b"")
    with pytest.raises(NotConnectedError):
        await a.fakes["i2"].port.call(b"")
    a.fakes["i1"].port.send(b"to nobody")
    nonsense: Any = "text"
    with pytest.raises(TypeError):
        a.fakes["i1"].port.send(nonsense)
