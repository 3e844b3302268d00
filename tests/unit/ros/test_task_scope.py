"""Tasks that live as long as a block."""

from __future__ import annotations

import asyncio

import pytest

from rce.ros.tasks import TaskScope


async def test_leaving_cancels_what_runs() -> None:
    async with asyncio.timeout(5):
        async with TaskScope() as scope:
            task = scope.start(asyncio.sleep(1000), name="sleeper")
    assert task.cancelled()


async def test_what_is_begun_while_leaving_does_nothing() -> None:
    done: list[str] = []
    begun: list[asyncio.Task[None]] = []

    async def late() -> None:
        done.append("late")
        await asyncio.sleep(1000)

    async def last_words(scope: TaskScope) -> None:
        try:
            await asyncio.sleep(1000)
        finally:
            begun.append(scope.start(late(), name="late"))

    async with asyncio.timeout(5):
        async with TaskScope() as scope:
            scope.start(last_words(scope), name="speaker")
            await asyncio.sleep(0)
    assert begun[0].cancelled()
    assert done == []


async def test_a_task_that_fails_ends_the_block() -> None:
    async def fail() -> None:
        raise ValueError("broken")

    async def block() -> None:
        async with TaskScope() as scope:
            scope.start(fail(), name="failing")
            await asyncio.sleep(1000)

    with pytest.raises(ExceptionGroup) as caught:
        await block()
    assert caught.group_contains(ValueError, match="broken")
