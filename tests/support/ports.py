"""TCP ports for programs under test, so that tests beside each other never get the same."""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import socket
from collections.abc import Iterator

FIRST, END = 15_000, 32_000
"""Below the ports that the system gives to outgoing connections."""


def slice_of(worker: str, workers: int) -> range:
    """Return the ports of one worker of a parallel run.

    Args:
        worker: Its name as pytest-xdist gives it, ``gw0``, ``gw1`` ...; empty in a serial run.
        workers: How many there are.
    """
    number = int(worker.removeprefix("gw") or 0)
    size = (END - FIRST) // max(workers, 1)
    return range(FIRST + number * size, FIRST + (number + 1) * size)


def _in_turn() -> Iterator[int]:
    """Go through this process's ports again and again, from a random one: a port comes back late."""
    environ = os.environ
    ports = slice_of(
        environ.get("PYTEST_XDIST_WORKER", ""), int(environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    )
    start = random.randrange(len(ports))
    return itertools.cycle((*ports[start:], *ports[:start]))


_ports = _in_turn()


def free_ports(count: int) -> list[int]:
    """Return TCP ports that no program uses now and that no other test of this run gets."""
    found: list[int] = []
    while len(found) < count:
        port = next(_ports)
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            found.append(port)
    return found


def free_port() -> int:
    """Return one such port."""
    return free_ports(1)[0]


def free_row(count: int) -> int:
    """Return the first of so many free ports in a row."""
    while True:
        first, *others = sorted(free_ports(count))
        if others == list(range(first + 1, first + count)):
            return first
