"""Running a node's program: its event loop, and SIGINT and SIGTERM as a request to stop."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from rce.ros.node.hosting import hosted_program

T = TypeVar("T")


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run a node's coroutine to its end and return its result: ``run(main())``.

    As :func:`asyncio.run`, but on uvloop's event loop where that is installed: a message then takes a
    node a fifth less time.
    """
    try:
        import uvloop
    except ImportError:  # uvloop does not support Windows
        return asyncio.run(main)
    return uvloop.run(main)


_SIGNALS = (signal.SIGINT, signal.SIGTERM)

StopCallback = Callable[[str], None]

_callbacks: dict[asyncio.AbstractEventLoop, list[StopCallback]] = {}
"""What the next signal calls, by event loop; a loop that is not in here leaves signals their usual effect."""


@contextmanager
def stop_signals(callback: StopCallback) -> Iterator[None]:
    """Call ``callback(reason)`` at the first signal. The second one has its usual effect.

    A signal is for all nodes of a program: it calls the callbacks of all blocks that have begun.

    Without effect outside the main thread, where Python takes no signals, and in a program that shares its
    process with others: they belong to the process.
    """
    if threading.current_thread() is not threading.main_thread() or hosted_program() is not None:
        yield
        return
    loop = asyncio.get_running_loop()
    callbacks = _callbacks.get(loop)
    if callbacks is None:
        callbacks = _callbacks[loop] = []
        for number in _SIGNALS:
            loop.add_signal_handler(number, _received, loop, number)
    callbacks.append(callback)
    try:
        yield
    finally:
        callbacks.remove(callback)
        if not callbacks and _callbacks.get(loop) is callbacks:  # not those of a block after a signal
            _leave_signals(loop)


def _received(loop: asyncio.AbstractEventLoop, number: signal.Signals) -> None:
    for callback in _leave_signals(loop):
        callback(f"received {number.name}")


def _leave_signals(loop: asyncio.AbstractEventLoop) -> list[StopCallback]:
    """Give signals their usual effect again; return what they were to call."""
    for number in _SIGNALS:
        loop.remove_signal_handler(number)
    return _callbacks.pop(loop, [])
