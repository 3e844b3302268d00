"""When a client gives a connection up: not because of a slow link, but if nothing is heard."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from integration.client.conftest import TIMING
from support.client_types import STRING, ros_string
from support.cloud import PASSWORD
from support.slow_link import SlowLink

from rce_client.connection import Connection, State

if TYPE_CHECKING:
    from integration.client.conftest import Engine

PATIENCE = replace(TIMING, ping_interval=0.5, ping_timeout=1.0)
"""Short, so that a slow link takes much longer."""


def connection(engine: Engine, states: list[State]) -> Connection:
    return Connection(
        engine.door.url,
        "testUser",
        PASSWORD,
        "testRobot",
        timing=PATIENCE,
        on_state=lambda state, _: states.append(state),
    )


async def test_endpoint_that_hangs_is_given_up(engine: Engine) -> None:
    """Although the kernel of its machine takes what the client goes on to send."""
    states: list[State] = []
    async with connection(engine, states) as conn:
        publisher = await conn.publisher("chat", STRING)
        await publisher.wait_active(60)
        engine.stop_reading()

        async def talk() -> None:
            while True:
                publisher.publish({"data": "hello"})
                await asyncio.sleep(0.02)

        talking = asyncio.create_task(talk())
        async with asyncio.timeout(60):
            while State.RESTORED not in states:
                await asyncio.sleep(0.02)
        talking.cancel()
        await asyncio.gather(talking, return_exceptions=True)


@pytest.mark.parametrize(("up", "down"), [(400e3, 0.0), (0.0, 400e3)])
async def test_slow_link_is_kept(engine: Engine, up: float, down: float) -> None:
    """A message takes longer than a client waits for the answer to a ping."""
    states: list[State] = []
    text = "x" * 2_000_000
    async with SlowLink(engine.cloud.ws_url, up=up, down=down).running() as link:
        engine.door.body = f'{{"url": "{link.url}"}}'
        async with connection(engine, states) as conn, asyncio.timeout(120):
            publisher = await conn.publisher("chat", STRING)
            subscriber = await conn.subscriber("news", STRING)
            await publisher.wait_active(60)
            await subscriber.wait_active(60)
            if up:
                publisher.publish({"data": text})
                assert await engine.end("chat").received.get() == ros_string(text)
            else:
                engine.end("news").port.send(ros_string(text))
                assert (await anext(aiter(subscriber)))["data"] == text
        assert State.LOST not in states


async def test_link_that_hangs_is_given_up(engine: Engine) -> None:
    """Nothing is passed on, in the middle of a large message that fills all buffers."""
    states: list[State] = []
    async with SlowLink(engine.cloud.ws_url, up=400e3).running() as link:
        engine.door.body = f'{{"url": "{link.url}"}}'
        async with connection(engine, states) as conn, asyncio.timeout(120):
            publisher = await conn.publisher("chat", STRING)
            await publisher.wait_active(60)
            publisher.publish({"data": "x" * 20_000_000})
            link.hangs = True
            while State.LOST not in states:
                await asyncio.sleep(0.02)
            link.hangs = False
