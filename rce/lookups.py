"""Look up host names without delaying the event loop or the program's end.

``socket.getaddrinfo`` blocks for half a minute and more while a name server does not answer, and cannot be
cancelled. Event loops run it in threads that the program waits for when it ends, and of which there are few:
some names without an answer then delay all others. Here each name that is being looked up has one thread,
shared by all callers, which ends with the program.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

MAX_THREADS = 32
"""How many names are looked up at the same time; further ones wait."""

Info = tuple[socket.AddressFamily, socket.SocketKind, int, str, Any]
"""Family, type, protocol, canonical name and socket address, as ``socket.getaddrinfo`` returns them."""

Question = Callable[[], Any]
"""Blocks until it has the answer or raises an exception."""

_Key = tuple[Any, ...]
_Waiter = tuple[asyncio.AbstractEventLoop, "asyncio.Future[Any]"]


class Lookups:
    """Answers questions that block, each in a daemon thread.

    Args:
        limit: The largest number of threads.
        pose: Does the work of :meth:`addresses`; as ``socket.getaddrinfo``.
    """

    def __init__(self, limit: int = MAX_THREADS, pose: Callable[..., Any] = socket.getaddrinfo) -> None:
        self._limit = limit
        self._pose = pose
        self._lock = threading.Lock()
        self._open: dict[_Key, list[_Waiter]] = {}
        """The futures that wait for each answer."""
        self._queue: deque[tuple[_Key, Question]] = deque()
        """Questions that wait for a thread."""
        self.threads = 0
        """How many threads there are now."""

    async def addresses(
        self,
        host: str | None,
        port: int,
        *,
        family: int = socket.AF_UNSPEC,
        flags: int = 0,
        kind: int = socket.SOCK_STREAM,
    ) -> list[Info]:
        """Return the addresses of a host as ``socket.getaddrinfo`` does.

        Args:
            host: A name or an address; None for this machine's own.
            port: A port.
            family: Addresses of this family only.
            flags: ``socket.AI_...``.
            kind: Type of the sockets.

        Raises:
            OSError: The name cannot be resolved (``socket.gaierror``).
            UnicodeError: It cannot be a host name.
        """
        key = (host, port, family, kind, 0, flags)
        found: list[Info] = await self._ask(key, partial(self._pose, *key))
        return found

    async def own_name(self) -> str:
        """Return this machine's full name as ``socket.getfqdn`` does."""
        found: str = await self._ask(("own name",), socket.getfqdn)
        return found

    async def _ask(self, key: _Key, question: Question) -> Any:
        loop = asyncio.get_running_loop()
        waiter = loop, loop.create_future()
        with self._lock:
            is_new = key not in self._open
            self._open.setdefault(key, []).append(waiter)
            if is_new:
                self._queue.append((key, question))
                self._add_thread()
        try:
            return await waiter[1]
        finally:
            with self._lock:
                self._forget(key, waiter)

    def _add_thread(self) -> None:
        if self.threads >= self._limit:
            return
        self.threads += 1
        try:
            threading.Thread(target=self._work, name="name lookup", daemon=True).start()
        except RuntimeError as error:  # the system has no more
            self.threads -= 1
            if not self.threads:
                key, _ = self._queue.pop()
                _answer(self._open.pop(key), OSError(errno.EAGAIN, f"no name can be looked up: {error}"))

    def _forget(self, key: _Key, waiter: _Waiter) -> None:
        """Remove a waiting future; with the last one, remove its question if that has no thread yet."""
        waiters = self._open.get(key, [])
        if waiter not in waiters:
            return
        waiters.remove(waiter)
        if waiters:
            return
        for queued in self._queue:
            if queued[0] == key:
                self._queue.remove(queued)
                del self._open[key]
                return

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._queue:
                    self.threads -= 1
                    return
                key, question = self._queue.popleft()
            try:
                result = question()
            except (OSError, UnicodeError) as error:
                result = error
            except Exception as error:  # noqa: BLE001 - such as a port beyond all limits
                result = socket.gaierror(socket.EAI_FAIL, str(error) or type(error).__name__)
            with self._lock:
                waiters = self._open.pop(key)
            _answer(waiters, result)


def _answer(waiters: list[_Waiter], result: Any) -> None:
    for loop, future in waiters:
        with contextlib.suppress(RuntimeError):  # the loop was closed
            loop.call_soon_threadsafe(_settle, future, result)


def _settle(future: asyncio.Future[Any], result: Any) -> None:
    if future.done():  # cancelled
        return
    if isinstance(result, Exception):
        future.set_exception(type(result)(*result.args))  # one for each: tracebacks are added to it
    else:
        future.set_result(result)


LOOKUPS = Lookups()
"""The program's shared lookups."""
