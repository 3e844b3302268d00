"""Flow control between a sender and a receiver."""

from __future__ import annotations

import asyncio

import pytest

from rce.aio.window import Window


async def test_no_more_is_granted_than_was_given_back() -> None:
    window = Window(100)
    assert (await window.reserve(60), await window.reserve(60)) == (60, 40)
    assert window.is_closed
    waiting = asyncio.create_task(window.reserve(60))
    await asyncio.sleep(0)
    assert not waiting.done()
    window.give_back(25)
    assert await waiting == 25
    window.give_back(1)
    assert not window.is_closed


async def test_two_senders_share_what_is_given_back() -> None:
    window = Window(0)
    both = [asyncio.create_task(window.reserve(10)) for _ in range(2)]
    for _ in range(3):
        await asyncio.sleep(0)
    window.give_back(10)
    done, waiting = await asyncio.wait(both, timeout=0.05)
    assert [task.result() for task in done] == [10]
    window.give_back(4)
    assert await waiting.pop() == 4


@pytest.mark.parametrize("given_back", [0, 5])
async def test_without_a_limit_all_is_granted(given_back: int) -> None:
    window = Window(None)
    window.give_back(given_back)
    assert [await window.reserve(1 << 30) for _ in range(3)] == [1 << 30] * 3
    assert not window.is_closed
