"""SIGINT and SIGTERM as a request to stop."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def handled(callback: Callable[[str], None]) -> Iterator[None]:
    """Call ``callback(reason)`` at the first signal. The second one does what it always does.

    Without effect outside the main thread, where Python takes no signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    loop = asyncio.get_running_loop()

    def release() -> None:
        for number in _SIGNALS:
            loop.remove_signal_handler(number)

    def received(number: signal.Signals) -> None:
        release()
        callback(f"received {number.name}")

    for number in _SIGNALS:
        loop.add_signal_handler(number, received, number)
    try:
        yield
    finally:
        release()
