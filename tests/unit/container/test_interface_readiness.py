"""How a container's interfaces wait for nodes that start."""

from __future__ import annotations

import asyncio

import pytest

from rce_container.environment import interfaces
from rce_container.environment.interfaces import Readiness

MANY = 1000
LOOKS = 5


async def test_interfaces_that_wait_share_their_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """With looks of its own for each, thousands kept the event loop from all other work."""
    monkeypatch.setattr(interfaces, "_LOOK_AGAIN_S", 0.001)
    looks = 0

    def settling() -> bool:
        nonlocal looks
        looks += 1
        return looks <= LOOKS

    readiness = Readiness(settling)
    never = asyncio.Event()
    async with asyncio.timeout(60):
        await asyncio.gather(*(readiness.wait(never.wait()) for _ in range(MANY)))
    assert looks <= LOOKS + 1 + MANY / interfaces._RELEASED_AT_ONCE


async def test_interface_waits_no_longer_than_for_its_node() -> None:
    readiness = Readiness(lambda: True)
    first, second = asyncio.Event(), asyncio.Event()
    waits = [asyncio.create_task(readiness.wait(event.wait())) for event in (first, second)]
    first.set()
    async with asyncio.timeout(60):
        await waits[0]
    assert not waits[1].done()
    waits[1].cancel()
    with pytest.raises(asyncio.CancelledError):
        await waits[1]


async def test_interface_waits_for_nodes_that_start_later() -> None:
    """Also if it had not to wait for any before."""
    starting = False
    readiness = Readiness(lambda: starting)
    never = asyncio.Event()
    async with asyncio.timeout(60):
        await readiness.wait(never.wait())
        starting = True
        wait = asyncio.create_task(readiness.wait(never.wait()))
        for _ in range(5):
            await asyncio.sleep(0)
        assert not wait.done()
        starting = False
        await wait


async def test_node_that_never_registers_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interfaces, "READY_TIMEOUT_S", 0.01)
    async with asyncio.timeout(60):
        await Readiness(lambda: True).wait(asyncio.Event().wait())
