"""Latched messages on links: one of each source, for as long as the source is there."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import msgspec
import pytest

from rce.control.model import ConnectionSpec, LinkSpec
from rce.link.frame_reader import FrameReader
from rce.link.frames import LATCHED, VERSION, Frame, FrameType, encode
from rce.link.latch import MAX_SOURCES
from rce.link.settings import LinkLimits

if TYPE_CHECKING:
    from .conftest import Rig

MIB = 1 << 20
TOPIC_OUT = ("SubscriberConverter", "PublisherInterface")


async def test_a_later_peer_gets_one_message_of_each_source(rig: Rig, way: str) -> None:
    """What ended before it came, or while it is there, is not in force."""
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    connections = list(b.spec.connections)
    await b.apply(connections=[])
    await a.connected()
    port = a.fakes["i1"].port
    for source, text in (("x", b"old"), ("y", b"of y"), ("z", b"of z"), ("x", b"of x")):
        port.send(text, latched=True, source=source)
    port.keep_latched(["x", "y"])
    await b.apply(connections=connections)
    await a.connected(1)
    heard = b.fakes["i1"]
    await heard.until_latched(b"of x", b"of y")
    port.send(b"newer", latched=True, source="y")
    await heard.until_latched(b"of x", b"newer")
    port.keep_latched(["y"])
    await heard.until_latched(b"newer")
    await b.apply(connections=[])
    await heard.until_latched()


async def test_short_memory_takes_other_messages_first(rig: Rig) -> None:
    """A latched message that waits on a slow link comes; one that had to go is told of."""
    a, b = await rig.pair("unix")
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    port, heard = a.fakes["i1"].port, b.fakes["i1"]
    port.send(bytes(8 * MIB))  # more than the socket takes at once
    port.send(bytes(MIB))
    port.send(b"map" * MIB, latched=True, source="x")
    a.endpoint.shed(MIB)
    assert not a.faults
    await heard.until_latched(b"map" * MIB)
    port.send(bytes(8 * MIB))
    port.send(b"new" * MIB, latched=True, source="x")
    port.send(b"of y", latched=True, source="y")
    a.endpoint.shed(4 * MIB)
    assert a.faults == ["interface i1: memory is short; its latched message was dropped"]
    assert a.endpoint.waiting_bytes < 9 * MIB
    await heard.until_latched(b"of y")


@pytest.mark.parametrize("way", ["unix", "tcp"])
async def test_a_lost_link_ends_no_source_but_what_ended_meanwhile(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    port, heard = a.fakes["i1"].port, b.fakes["i1"]
    for source in "xy":
        port.send(source.encode(), latched=True, source=source)
    await heard.until_latched(b"x", b"y")
    (link,) = b.endpoint._links
    link.detach()
    port.keep_latched(["y"])
    assert sorted(heard.latched.values()) == [b"x", b"y"]
    await heard.until_latched(b"y")
    assert heard.active == [True, False, True]


async def test_a_peer_of_the_first_version_is_told_of_no_sources(rig: Rig) -> None:
    """It gets the latched messages, with an id that it does not look at, and frames that it knows."""
    hub = await rig.hub()
    b = rig.party("b", hub)
    await rig.listen(b, "unix")
    await b.apply(
        {"i1": "SubscriberInterface"},
        [LinkSpec(id="L", peer="user/a", token="secret", dial=False)],
        [ConnectionSpec(id=1, link="L", interface="i1", peer_interface="x")],
    )
    await b.until(lambda: "i1" in b.fakes)
    port = b.fakes["i1"].port
    for source in "xy":
        port.send(source.encode(), latched=True, source=source)
    reader, writer = await asyncio.open_unix_connection(b.address.unix)
    hello = msgspec.json.encode({"version": VERSION, "link": "L", "token": "secret"})
    writer.write(encode(Frame(FrameType.HELLO, payload=hello)) + encode(Frame(FrameType.OPEN, 1)))
    await b.connected(1)
    port.keep_latched(["y"])
    port.send(b"last")
    frames: list[Frame] = []
    known = FrameReader(LinkLimits())
    async with asyncio.timeout(60):
        while not frames or frames[-1].payload != b"last":
            frames += known.feed(await reader.read(1000))
    writer.close()
    await b.connected()
    assert frames[0] == Frame(FrameType.WELCOME)
    assert FrameType.SOURCES not in {frame.type for frame in frames}
    data = [(bytes(f.payload), f.flags) for f in frames if f.type is FrameType.DATA]
    assert data == [(b"x", LATCHED), (b"y", LATCHED), (b"last", 0)]


async def test_a_peer_with_too_many_sources_loses_its_oldest(rig: Rig) -> None:
    """A peer may say what it likes: what is kept of it is bounded, also if its messages are empty."""
    hub = await rig.hub()
    b = rig.party("b", hub)
    await rig.listen(b, "unix")
    await b.apply(
        {"i1": "PublisherInterface"},
        [LinkSpec(id="L", peer="user/a", token="secret", dial=False)],
        [ConnectionSpec(id=1, link="L", interface="i1", peer_interface="x")],
    )
    await b.until(lambda: "i1" in b.fakes)
    _, writer = await asyncio.open_unix_connection(b.address.unix)
    hello = msgspec.json.encode({"version": VERSION, "link": "L", "token": "secret"})
    writer.write(encode(Frame(FrameType.HELLO, payload=hello)) + encode(Frame(FrameType.OPEN, 1)))
    await b.connected(1)
    for number in range(MAX_SOURCES + 10):
        writer.write(encode(Frame(FrameType.DATA, 1, number, LATCHED)))
    writer.write(encode(Frame(FrameType.DATA, 1, 0, 0, b"last")))
    heard = b.fakes["i1"]
    async with asyncio.timeout(60):
        while await heard.received.get() != (b"last", False):
            pass
    assert list(heard.latched) == [f"1.{number}" for number in range(10, MAX_SOURCES + 10)]
    writer.close()
    await b.connected()
