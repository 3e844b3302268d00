"""The loops that choose tasks are compiled by another process, and used by this one afterwards."""

from __future__ import annotations

import asyncio
import logging

import psutil
import pytest

from rce_fleet.compiled import is_available
from rce_fleet.nodes.task_loops import LOOPS, compile_beside

LOG = logging.getLogger("manager")

pytestmark = pytest.mark.skipif(not is_available(), reason="numba is missing (pip install rce[compiled])")


def compilers() -> list[psutil.Process]:
    return [child for child in psutil.Process().children() if "rce_fleet.nodes.task_loops" in child.cmdline()]


async def test_loops_are_used_when_they_are_compiled() -> None:
    async with asyncio.timeout(120):
        await compile_beside(LOG)
    assert all(loop.is_compiled for loop in LOOPS)
    assert compilers() == []


async def test_cancelling_ends_the_compiler() -> None:
    compiling = asyncio.create_task(compile_beside(LOG))
    async with asyncio.timeout(30):
        while not compilers():
            await asyncio.sleep(0.01)
    compiling.cancel()
    await asyncio.wait([compiling])
    assert compilers() == []
    assert not any(loop.is_compiled for loop in LOOPS)
