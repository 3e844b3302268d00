"""Blocking work in threads, whose callers are cancelled."""

from __future__ import annotations

import asyncio
import threading

import pytest

from rce_container.packages.disk import in_thread, make_in_thread


class Held:
    """A blocking function that waits until it is released."""

    def __init__(self) -> None:
        self.began, self.go_on = threading.Event(), threading.Event()

    def __call__(self) -> int:
        self.began.set()
        self.go_on.wait(60)
        return 7


async def cancel_twice(task: asyncio.Task[int], held: Held) -> None:
    await asyncio.to_thread(held.began.wait, 60)
    for _ in range(2):
        task.cancel()
        await asyncio.sleep(0)
    assert not task.done(), "its thread still uses what the caller is about to close"
    held.go_on.set()
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_a_caller_cancelled_twice_waits_for_its_thread() -> None:
    held = Held()
    await cancel_twice(asyncio.create_task(in_thread(held)), held)


async def test_what_is_made_for_a_cancelled_caller_is_undone() -> None:
    """A mounted image would stay mounted, and no container could have it."""
    held, undone = Held(), list[int]()
    await cancel_twice(asyncio.create_task(make_in_thread(held, undone.append)), held)
    assert undone == [7]
    assert await make_in_thread(held, undone.append) == 7
    assert undone == [7]
