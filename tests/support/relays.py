"""Relays of one topic, and links that relay a whole graph over one connection."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

from rce.ros.core import Core
from rce.ros.multimaster.filters import SyncLists
from rce.ros.multimaster.sync import MasterSync, SyncSettings
from rce.ros.node import Message, Publisher, Subscriber
from support.multimaster import STRING, node


async def published_until_heard(publisher: Publisher, heard: Subscriber, **fields: object) -> Message:
    """Publish a message again and again until a subscriber of the relay's target has one.

    A connection alone does not show that the relay takes messages: it opens one to learn the type.
    """
    arrived = asyncio.ensure_future(anext(aiter(heard)))
    async with asyncio.timeout(60):
        while not arrived.done():
            publisher.publish(**fields)
            await asyncio.sleep(0.02)
    return await arrived


async def heard_at_once(uri: str, topic: str, count: int) -> set[str]:
    """Subscribe, and wait for so many messages, without any being published."""
    async with node(f"late_{count}", uri) as late:
        heard = aiter(await late.subscribe(topic, STRING))
        async with asyncio.timeout(60):
            return {(await anext(heard)).data for _ in range(count)}


async def latching(core: Core, name: str, topic: str, nodes: AsyncExitStack) -> Publisher:
    """A node that has latched its name."""
    started = await nodes.enter_async_context(node(name, core.uri))
    publisher = await started.advertise(topic, STRING, latch=True)
    publisher.publish(data=name)
    return publisher


async def check_that_all_that_is_latched_is_heard(source: Core, target: str, topics: tuple[str, str]) -> None:
    """Each of two publishers, by each of two subscribers; then no longer the one that ended."""
    here, there = topics
    async with AsyncExitStack() as nodes, AsyncExitStack() as brief:
        one = await latching(source, "one", here, nodes)
        await latching(source, "two", here, brief)
        async with node("listener", target) as listener:
            heard = aiter(await listener.subscribe(there, STRING))
            async with asyncio.timeout(60):
                assert {(await anext(heard)).data, (await anext(heard)).data} == {"one", "two"}
            assert await heard_at_once(target, there, 2) == {"one", "two"}
            await brief.aclose()
            async with asyncio.timeout(60):
                while "two" in await heard_before_a_mark(one, target, there):
                    pass


async def heard_before_a_mark(marking: Publisher, uri: str, topic: str) -> set[str]:
    """Return what a new subscriber is given before something that is published then."""
    found: set[str] = set()
    async with node("asking", uri) as asking:
        subscriber = await asking.subscribe(topic, STRING)
        await subscriber.wait_for_publishers(timeout=60)
        mark = f"mark {id(subscriber)}"
        marking.publish(data=mark)
        while mark not in found:
            found.add((await anext(aiter(subscriber))).data)
    return found


@asynccontextmanager
async def linked(
    token: str = "", **lists: list[str]
) -> AsyncIterator[tuple[Core, Core, MasterSync, MasterSync]]:
    """Two cores that know each other by one connection only: no discovery, no direct way."""
    chosen = SyncLists.read(lists)
    async with Core(port=0) as cloud, Core(port=0) as robot:
        listening = SyncSettings(
            cloud.uri, relay_listen=0, relay_addr="127.0.0.1", relay_token="t", relay_name="cloud"
        )
        async with MasterSync(listening) as one:
            dialing = SyncSettings(
                robot.uri,
                lists=chosen,
                relay_to=(("127.0.0.1", one.relay_port),),
                relay_token=token or "t",
                relay_name="robot",
            )
            async with MasterSync(dialing) as other:
                yield cloud, robot, one, other


@asynccontextmanager
async def sync_of(core: Core, **settings: Any) -> AsyncIterator[MasterSync]:
    """One side of a link, with the token that both sides need."""
    async with MasterSync(SyncSettings(core.uri, relay_token="t", **settings)) as sync:
        yield sync
