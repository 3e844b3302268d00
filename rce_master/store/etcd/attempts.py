"""Attempts at one request, each at another member of etcd."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING, Self

from rce.tls import explain_to_client

if TYPE_CHECKING:
    from collections.abc import Coroutine

    import aiohttp


class FailedError(Exception):
    """One endpoint did not do a request; another one may."""

    def __init__(self, reason: str, *, maybe_done: bool) -> None:
        super().__init__(reason)
        self.maybe_done = maybe_done


class Attempts:
    """Runs the attempts at one request side by side; ends those that are left at its own end."""

    def __init__(self) -> None:
        self._running: dict[asyncio.Task[bytes], int] = {}

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self._running:
            task.cancel()
        await asyncio.gather(*self._running, return_exceptions=True)

    @property
    def are_left(self) -> bool:
        """Whether one is under way."""
        return bool(self._running)

    def begin(self, member: int, attempt: Coroutine[object, object, bytes]) -> None:
        """Begin an attempt at a member with a number."""
        self._running[asyncio.create_task(attempt, name=f"ask member {member} of etcd")] = member

    async def next(self) -> tuple[int, asyncio.Task[bytes]]:
        """Wait until one has ended; return the number of its member, and the attempt."""
        done, _ = await asyncio.wait(self._running, return_when=asyncio.FIRST_COMPLETED)
        first = next(iter(done))
        return self._running.pop(first), first


def connect_text(error: aiohttp.ClientConnectorError) -> str:
    """Return why a member cannot be connected to."""
    if (explained := explain_to_client(error)) is not None:
        return explained
    number = error.os_error.errno or 0
    # asyncio's own text leaves out why; numbers of failed look-ups are negative.
    return os.strerror(number) if number > 0 else error.os_error.strerror or str(error.os_error)


def not_etcd(status: int, answer: bytes, *, tls: bool) -> str:
    """Return what is wrong with an answer that is not etcd's."""
    if not tls and b"HTTPS" in answer:
        return "it uses TLS; name it etcds://"
    return f"this is not etcd's gateway: it answered {status}"
