"""What a link refuses: wrong tokens, unknown links, garbage, silence, broken rules."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace
from support.link_frames import answer, hello, read_on
from support.link_kinds import TOPIC_OUT

from rce.control.model import ConnectionSpec, LinkSpec
from rce.link import (
    LinkLimits,
    LinkRefusedError,
)
from rce.link.frames import HEADER, Frame, FrameType, encode
from rce.link.handshake import check_answer, encode_hello

if TYPE_CHECKING:
    from .conftest import Rig


@pytest.mark.parametrize("way", ["unix", "tcp", "handed-over"])
async def test_wrong_token_and_unknown_link_are_refused(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way, unknown_link=0.05)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    for link, token in (("L", "wrong"), ("L", ""), ("M", "secret")):
        reader, writer = await hello(b.address, encode_hello(link, token))
        with pytest.raises(LinkRefusedError, match="unknown link or wrong token"):
            check_answer(await answer(reader))
        assert await reader.read() == b""
        writer.close()
        await writer.wait_closed()
    assert a.endpoint.connections == (1,)
    assert a.fakes["i1"].active == [True]


@pytest.mark.parametrize("way", ["local", "unix"])
async def test_endpoint_with_a_wrong_token_does_not_connect(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    await a.apply(links=[])
    await a.apply(links=[LinkSpec(id="L", peer="user/b", token="wrong", dial=True, address=b.address)])
    with pytest.raises(LinkRefusedError):
        await a.hub.connect(a.spec.links[0])
    assert a.endpoint.connections == ()


async def test_former_place_does_not_get_its_link_back(rig: Rig, way: str) -> None:
    """A machine that hung dials when it wakes, before it hears that its endpoint was placed elsewhere."""
    former, b = await rig.pair(way)
    await rig.join(former, b, [TOPIC_OUT])
    await former.apply(links=[replace(former.spec.links[0], epoch=1)])
    await former.connected(1)
    await b.apply(links=[replace(b.spec.links[0], peer_epoch=2)])
    present = rig.party("a", former.hub if way == "local" else await rig.hub())
    (link,) = former.spec.links
    await present.apply({"i1": TOPIC_OUT[0]}, [replace(link, epoch=2)], list(former.spec.connections))
    await present.connected(1)
    with pytest.raises(LinkRefusedError):
        await former.hub.connect(link)
    await former.connected()
    assert present.endpoint.connections == b.endpoint.connections == (1,)
    assert present.fakes["i1"].active == [True]


async def test_place_of_a_release_before_is_taken(rig: Rig) -> None:
    """It says no epoch."""
    _, b = await rig.pair("unix")
    await b.apply(links=[LinkSpec(id="L", peer="user/a", token="secret", dial=False, peer_epoch=2)])
    for epoch, is_taken in ((None, True), (1, False), (2, True), (3, True)):
        reader, writer = await hello(b.address, encode_hello("L", "secret", epoch=epoch))
        with contextlib.nullcontext() if is_taken else pytest.raises(LinkRefusedError):
            check_answer(await answer(reader))
        writer.close()
        await writer.wait_closed()


@pytest.mark.parametrize("way", ["unix", "tcp", "handed-over"])
async def test_link_may_be_asked_for_before_its_spec_came(
    rig: Rig, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, b = await rig.pair(way, unknown_link=5.0)
    asked = asyncio.Event()
    wait = b.hub.wait_registered

    async def note_and_wait(link_id: str, timeout: float | None) -> None:
        asked.set()
        await wait(link_id, timeout)

    monkeypatch.setattr(b.hub, "wait_registered", note_and_wait)
    reader, writer = await hello(b.address, encode_hello("L", "secret"))
    await asked.wait()
    await b.apply(links=[LinkSpec(id="L", peer="user/a", token="secret", dial=False)])
    check_answer(await answer(reader))
    writer.close()
    await writer.wait_closed()


@pytest.mark.parametrize("way", ["unix", "tcp", "handed-over"])
@pytest.mark.parametrize(
    "garbage",
    [
        b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
        b"\0" * 24,
        encode(Frame(FrameType.PING)),
        encode_hello("x" * 5_000, ""),
    ],
    ids=["http", "zeros", "ping", "long hello"],
)
async def test_garbage_ends_its_own_connection_only(rig: Rig, way: str, garbage: bytes) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    reader, writer = await hello(b.address, garbage)
    try:
        rest = await reader.read()
    except ConnectionResetError:
        rest = b""
    assert rest == b""
    writer.close()
    a.fakes["i1"].port.send(b"unhurt")
    assert await b.fakes["i1"].received.get() == (b"unhurt", False)


async def test_stranger_cannot_send_on_while_its_link_is_looked_for(rig: Rig) -> None:
    """What comes before the answer to HELLO is kept in memory, and counts for no user."""
    _, b = await rig.pair("tcp", handshake=60.0, unknown_link=50.0)
    reader, writer = await hello(b.address, encode_hello("unknown", ""))
    frame = encode(Frame(FrameType.PING, payload=bytes(4_000)))
    writer.write(100 * frame)
    async with asyncio.timeout(20):
        while await read_on(reader):
            pass
    writer.close()


async def test_silent_connection_is_dropped(rig: Rig) -> None:
    _, b = await rig.pair("tcp", handshake=0.05)
    reader, writer = await hello(b.address, b"")
    assert await read_on(reader) == b""
    writer.close()


@pytest.mark.parametrize(
    "rule_breaker",
    [
        HEADER.pack(200, 0, 0, 0, 0, 0, 0),
        encode(Frame(FrameType.HELLO)),
        encode(Frame(FrameType.OPEN, 1)) + encode(Frame(FrameType.HELLO, 1)),
        b"".join(encode(Frame(FrameType.OPEN, n)) for n in range(1, 40)),
        encode(Frame(FrameType.OPEN, 2)) + 2 * encode(Frame(FrameType.CALL, 2, 7)),
        50 * (encode(Frame(FrameType.OPEN, 1)) + encode(Frame(FrameType.CLOSE, 1))),
    ],
    ids=[
        "unknown type",
        "second hello",
        "hello on a channel",
        "too many channels",
        "same call twice",
        "opens one channel again and again",
    ],
)
async def test_rule_breaking_peer_loses_its_link(rig: Rig, rule_breaker: bytes) -> None:
    hub = await rig.hub(limits=LinkLimits(max_channels=30))
    b = rig.party("b", hub)
    await rig.listen(b, "unix")
    await b.apply(
        {"i1": "PublisherInterface", "i2": "ServiceClientInterface"},
        [LinkSpec(id="L", peer="user/a", token="secret", dial=False)],
        [ConnectionSpec(id=n, link="L", interface=f"i{n}", peer_interface="x") for n in (1, 2)],
    )
    reader, writer = await hello(b.address, encode_hello("L", "secret"))
    check_answer(await answer(reader))
    writer.write(rule_breaker)
    while await read_on(reader):
        pass
    writer.close()
    await b.connected()
