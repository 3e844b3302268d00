"""The signals that end a program."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal

import pytest

from rce.own_process import EndSignals


async def test_first_signal_cancels_and_later_ones_hurry() -> None:
    hurried = 0
    begun = asyncio.Event()

    def hurry() -> None:
        nonlocal hurried
        hurried += 1

    async def work() -> None:
        try:
            begun.set()
            await asyncio.Event().wait()
        finally:
            while hurried < 2:  # a second cancellation would end this
                await asyncio.sleep(0)

    task = asyncio.create_task(work())
    signals = EndSignals(task, again=hurry)
    signals.handle()
    try:
        async with asyncio.timeout(60):
            await begun.wait()
            for sent, number in enumerate((signal.SIGTERM, signal.SIGINT, signal.SIGTERM)):
                os.kill(os.getpid(), number)
                while signals.came + hurried <= sent:
                    await asyncio.sleep(0.01)
            with pytest.raises(asyncio.CancelledError):
                await task
    finally:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            asyncio.get_running_loop().remove_signal_handler(number)
    assert signals.came


async def test_a_signal_at_the_end_of_a_timeout_is_not_lost() -> None:
    """The timeout has cancelled the task, which has not run since."""
    task: asyncio.Task[None]

    async def work() -> None:
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0):
                    asyncio.get_running_loop().call_soon(take)
                    await asyncio.Event().wait()

    def take() -> None:
        assert task.cancelling()
        signals.take()

    task = asyncio.create_task(work())
    signals = EndSignals(task)
    async with asyncio.timeout(60):
        with pytest.raises(asyncio.CancelledError):
            await task
