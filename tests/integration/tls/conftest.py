"""Tests in this folder run on both event loops."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping

import uvloop


def pytest_asyncio_loop_factories() -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    return {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}


# libuv keeps one pipe for signals from its first loop on; here, it is none of a test's leaks.
uvloop.new_event_loop().close()
