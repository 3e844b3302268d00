"""What an endpoint makes of its specs."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace

from rce.control.model import ConnectionSpec, LinkSpec, SpecPatch
from rce.link.endpoint import ADDED_AT_ONCE
from rce.model.specs import InterfaceSpec

if TYPE_CHECKING:
    from .conftest import Rig

TOPIC_OUT = ("SubscriberConverter", "PublisherInterface")
TOPIC_IN = ("PublisherConverter", "SubscriberInterface")


async def test_same_spec_again_changes_nothing(rig: Rig) -> None:
    a, b = await rig.pair("unix")
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    fake = a.fakes["i1"]
    await a.endpoint.apply(a.spec)
    await a.endpoint.apply(replace(a.spec, revision=99))
    assert a.fakes["i1"] is fake
    assert fake.active == [True]
    assert a.endpoint.connections == (1,)


async def test_changed_interface_is_made_anew(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT, TOPIC_IN])
    await a.connected(1, 2)
    old, kept = b.fakes["i1"], b.fakes["i2"]
    await b.apply({"i1": "PublisherForwarder", "i2": "SubscriberInterface"})
    assert old.closed
    assert old.active == [True, False]
    assert b.fakes["i2"] is kept
    assert kept.active == [True]
    await a.until(lambda: a.fakes["i1"].active == [True, False, True])
    a.fakes["i1"].port.send(b"to the new one")
    assert await b.fakes["i1"].received.get() == (b"to the new one", False)
    assert old.received.empty()


async def test_connection_opens_when_both_interfaces_have_started(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT], addr="/slow")
    await a.until(lambda: "i1" in a.fakes)
    await asyncio.sleep(0)
    a.fakes["i1"].may_start.set()
    a.fakes["i1"].port.send(b"too early")
    assert a.endpoint.connections == ()
    b.fakes["i1"].may_start.set()
    await a.connected(1)
    await b.connected(1)
    a.fakes["i1"].port.send(b"now")
    assert await b.fakes["i1"].received.get() == (b"now", False)


async def test_bad_interfaces_do_not_hurt_others(rig: Rig) -> None:
    a, b = await rig.pair("unix")
    await rig.join(a, b, [TOPIC_OUT])
    good = a.spec.interfaces
    bad = (
        InterfaceSpec(tag="b1", type="SubscriberConverter", message_type="a/B", addr="/unmakable"),
        InterfaceSpec(tag="b2", type="SubscriberConverter", message_type="a/B", addr="/bad"),
        InterfaceSpec(tag="b3", type="Nonsense", message_type="a/B"),
    )
    stray = (
        ConnectionSpec(id=8, link="L", interface="nothing", peer_interface="x"),
        ConnectionSpec(id=9, link="nowhere", interface="i1", peer_interface="x"),
    )
    spec = replace(a.spec, interfaces=(*bad, *good), connections=(*stray, *a.spec.connections))
    await a.endpoint.apply(spec)
    await a.connected(1)
    await a.until(lambda: len(a.faults) == 5)
    assert sorted(text.split(":")[0] for text in a.faults) == [
        "connection 8",
        "connection 9",
        "interface b1",
        "interface b2",
        "interface b3",
    ]
    assert "interface b2: cannot start" in a.faults
    assert "interface b1: cannot be made" in a.faults
    await a.endpoint.apply(replace(spec, revision=50))
    assert len(a.faults) == 5
    assert a.endpoint.interfaces == {"b2": False, "i1": True}


async def test_refused_message_is_a_fault_and_nothing_else(rig: Rig) -> None:
    a, b = await rig.pair("unix")
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    for payload in (b"refuse me", b"refuse me", b"good"):
        a.fakes["i1"].port.send(payload)
    assert await b.fakes["i1"].received.get() == (b"good", False)
    assert b.faults == ["interface i1: refused"]


async def test_one_subscriber_reaches_many_peers(rig: Rig) -> None:
    a, b = await rig.pair("unix")
    await rig.join(a, b, [TOPIC_OUT, TOPIC_OUT])
    await a.apply(
        {"i1": "SubscriberConverter"},
        connections=[ConnectionSpec(id=n, link="L", interface="i1", peer_interface=f"i{n}") for n in (1, 2)],
    )
    await a.connected(1, 2)
    await b.connected(1, 2)
    a.fakes["i1"].port.send(b"all")
    assert await b.fakes["i1"].received.get() == (b"all", False)
    assert await b.fakes["i2"].received.get() == (b"all", False)
    await a.apply(connections=[a.spec.connections[1]])
    assert a.fakes["i1"].active == [True]
    await b.connected(2)
    assert b.fakes["i1"].active == [True, False]


async def test_close_ends_everything(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT, TOPIC_IN])
    await a.connected(1, 2)
    await a.endpoint.close()
    assert a.fakes["i1"].closed
    assert a.fakes["i1"].active == [True, False]
    await b.connected()
    assert not b.fakes["i1"].closed
    with pytest.raises(RuntimeError):
        await a.endpoint.apply(a.spec)
    await a.endpoint.close()


async def test_starting_interface_can_be_removed(rig: Rig) -> None:
    a, b = await rig.pair("local")
    await rig.join(a, b, [TOPIC_OUT], addr="/slow")
    await asyncio.sleep(0)
    await a.apply({}, connections=[])
    assert a.fakes["i1"].closed
    assert a.endpoint.interfaces == {}
    assert a.faults == []


async def test_interface_that_does_not_close_is_given_up(rig: Rig) -> None:
    a, b = await rig.pair("local", close=0.05)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    a.fakes["i1"].may_close.clear()
    await a.apply({}, connections=[])
    assert a.endpoint.interfaces == {}
    assert a.faults == ["interface i1: takes too long to close"]


async def test_interfaces_are_closed_though_nobody_waits(rig: Rig) -> None:
    a, b = await rig.pair("local")
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    fake = a.fakes["i1"]
    fake.may_close.clear()
    applying = asyncio.ensure_future(a.apply({}, connections=[]))
    while not fake.closed:
        await asyncio.sleep(0)
    applying.cancel()
    await asyncio.wait([applying])
    fake.may_close.set()
    await a.endpoint.apply(a.spec)
    assert a.endpoint.interfaces == {}
    assert a.faults == []


async def test_two_interfaces_of_one_endpoint_are_joined(rig: Rig) -> None:
    """Topic and service; an end that is made anew is joined again, and all end when the link does."""
    party = rig.party("a", await rig.hub())
    types = {
        "out": "SubscriberConverter",
        "in": "PublisherConverter",
        "ask": "ServiceProviderConverter",
        "serve": "ServiceClientConverter",
    }
    link = LinkSpec(id="L", peer=party.spec.id, token="secret", dial=False)
    connections = [
        ConnectionSpec(id=1, link="L", interface="in", peer_interface="out"),
        ConnectionSpec(id=2, link="L", interface="ask", peer_interface="serve"),
    ]
    await party.apply(types, [link], connections)
    await party.connected(1, 2)
    party.fakes["out"].port.send(b"hello")
    assert await party.fakes["in"].received.get() == (b"hello", False)
    assert await party.fakes["ask"].port.call(b"loud") == b"LOUD"
    old = party.fakes["in"]
    await party.apply({**types, "in": "PublisherForwarder"})
    await party.connected(1, 2)
    party.fakes["out"].port.send(b"again")
    assert await party.fakes["in"].received.get() == (b"again", False)
    assert old.received.empty()
    assert party.faults == []
    await party.apply(connections=connections[:1])
    await party.connected(1)
    await party.apply(links=[], connections=[])
    await party.connected()
    assert not any(party.endpoint.interfaces.values())


async def test_a_copy_that_takes_over_is_joined_with_itself(rig: Rig) -> None:
    """Messages and calls pass from both ends of its link with itself, and what they latched before."""
    party = rig.party("a", await rig.hub())
    types = {
        "out1": "SubscriberConverter",
        "in1": "PublisherConverter",
        "out2": "SubscriberConverter",
        "in2": "PublisherConverter",
        "ask1": "ServiceProviderConverter",
        "serve1": "ServiceClientConverter",
        "ask2": "ServiceProviderConverter",
        "serve2": "ServiceClientConverter",
    }
    ends = [("out1", "in1"), ("in2", "out2"), ("ask1", "serve1"), ("serve2", "ask2")]
    link = LinkSpec(id="L", peer=party.spec.id, token="secret", dial=False, copy=True)
    connections = [
        ConnectionSpec(id=n, link="L", interface=one, peer_interface=other)
        for n, (one, other) in enumerate(ends, 1)
    ]
    await party.apply(types, [link], connections)
    await party.connected(1, 2, 3, 4)
    for number in "12":
        party.fakes[f"out{number}"].port.send(b"lost")
        party.fakes[f"out{number}"].port.send(b"map", latched=True)
    await party.apply(links=[replace(link, copy=False)])
    for number in "12":
        assert await party.fakes[f"ask{number}"].port.call(b"loud") == b"LOUD"
        party.fakes[f"out{number}"].port.send(b"hello")
        received = party.fakes[f"in{number}"].received
        assert await received.get() == (b"map", True)
        assert await received.get() == (b"hello", False)
    assert party.faults == []


async def test_a_connection_with_itself_to_nothing_is_told_once(rig: Rig) -> None:
    party = rig.party("a", await rig.hub())
    link = LinkSpec(id="L", peer=party.spec.id, token="secret", dial=False)
    wrong = [ConnectionSpec(id=1, link="L", interface="out", peer_interface="none")]
    await party.apply({"out": "SubscriberConverter"}, [link], wrong)
    await party.apply()
    assert party.faults == ["connection 1: there is no interface none"]


async def test_patches_do_what_whole_specs_do(rig: Rig) -> None:
    a, b = await rig.pair("unix")
    a.in_patches = b.in_patches = True
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    kept = a.fakes["i1"]
    link = a.spec.links[0]
    more = ConnectionSpec(id=7, link=link.id, interface="i9", peer_interface="i9")
    for party, type_ in ((a, "SubscriberInterface"), (b, "PublisherInterface")):
        types = {one.tag: one.type for one in party.spec.interfaces}
        await party.apply({**types, "i9": type_}, connections=[*party.spec.connections, more])
    await a.connected(1, 7)
    assert a.fakes["i1"] is kept
    news = a.endpoint.take_news()
    assert news.interfaces == {"i1": True, "i9": True}
    assert news.connections == [1, 7]
    await b.apply({"i1": "PublisherForwarder", "i9": "PublisherInterface"})
    await a.until(lambda: kept.active == [True, False, True])
    await a.apply({"i9": "SubscriberInterface"}, connections=[more])
    await a.connected(7)
    assert kept.closed
    news = a.endpoint.take_news()
    assert news.removed_interfaces == ["i1"]
    assert news.lost_connections == [1]
    assert not a.endpoint.take_news()
    await a.apply({}, [], [])
    assert a.endpoint.interfaces == {}
    assert a.endpoint.connections == ()


async def test_a_patch_costs_what_it_changes_and_not_what_is_there(rig: Rig) -> None:
    """Interfaces that a patch does not name are not looked at: their specs are not even compared."""
    a = rig.party("a", await rig.hub())
    await a.apply({f"i{number}": "SubscriberInterface" for number in range(200)})
    made = len(a.fakes)
    a.endpoint.take_news()
    extra = InterfaceSpec(tag="more", type="SubscriberInterface", message_type="test/Any")
    patch = SpecPatch(id=a.spec.id, base=a.spec.revision, revision=a.spec.revision + 1, interfaces=(extra,))
    await a.endpoint.patch(patch)
    assert len(a.fakes) == made + 1
    assert set(a.endpoint.take_news().changed_interfaces) == {"more"}


async def test_an_interrupted_patch_is_made_up_for_by_the_next(rig: Rig) -> None:
    a = rig.party("a", await rig.hub())
    await a.apply({"i1": "SubscriberInterface"})
    a.in_patches = True
    a.fakes["i1"].may_close.clear()
    task = asyncio.create_task(a.apply({"i2": "SubscriberInterface"}))
    await a.until(lambda: a.fakes["i1"].closed)
    task.cancel()
    await asyncio.wait([task])
    assert "i2" not in a.endpoint.interfaces
    a.fakes["i1"].may_close.set()
    await a.apply({"i2": "SubscriberInterface", "i3": "SubscriberInterface"})
    assert set(a.endpoint.interfaces) == {"i2", "i3"}


async def test_large_spec_is_applied_in_parts(rig: Rig) -> None:
    """The event loop of a container with thousands of interfaces serves its ROS core meanwhile."""
    a, b = await rig.pair("unix")
    turns = 0

    async def count() -> None:
        nonlocal turns
        while True:
            await asyncio.sleep(0)
            turns += 1

    counting = asyncio.create_task(count())
    try:
        before = turns
        await rig.join(a, b, [TOPIC_OUT] * 5 * ADDED_AT_ONCE)
        assert turns - before >= 2 * 2 * 4  # interfaces and connections, of both ends
        await a.connected(*range(1, 5 * ADDED_AT_ONCE + 1))
    finally:
        counting.cancel()
