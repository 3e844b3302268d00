"""When the robot endpoint gives the memory of former messages back."""

from __future__ import annotations

import subprocess
import sys

from rce_robot.memory import LEAST_UNUSED, MOST_UNUSED, UnusedMemory

OWN = 40 << 20


def test_what_messages_hold_is_not_given_back() -> None:
    unused = UnusedMemory(OWN)
    assert not unused.is_due(OWN + 500 * 2**20, 500 * 2**20, 1)
    assert not unused.is_due(OWN + 500 * 2**20, 500 * 2**20, 1)


def test_memory_is_kept_while_messages_come() -> None:
    """While messages come only what is beyond the most is given back."""
    unused = UnusedMemory(OWN)
    assert not unused.is_due(OWN + MOST_UNUSED, 0, 1)
    assert not unused.is_due(OWN + MOST_UNUSED, 0, 2)
    assert unused.is_due(OWN + MOST_UNUSED + 1, 0, 3)


def test_when_no_more_come_nearly_all_is_given_back() -> None:
    unused = UnusedMemory(OWN)
    assert not unused.is_due(OWN + LEAST_UNUSED + 1, 0, 1)
    assert unused.is_due(OWN + LEAST_UNUSED + 1, 0, 1)
    assert not unused.is_due(OWN + LEAST_UNUSED, 0, 1)


def test_what_cannot_be_given_back_is_not_tried_again_and_again() -> None:
    unused = UnusedMemory(OWN)
    assert unused.is_due(OWN + MOST_UNUSED + 1, 0, 1)
    unused.given_back(OWN + MOST_UNUSED, 0)
    assert not unused.is_due(OWN + MOST_UNUSED + 1, 0, 2)
    assert unused.is_due(OWN + MOST_UNUSED, 0, 2), "once more when messages have stopped"
    unused.given_back(OWN + MOST_UNUSED, 0)
    assert not unused.is_due(OWN + MOST_UNUSED, 0, 2)
    assert unused.is_due(OWN + MOST_UNUSED + LEAST_UNUSED + 1, 0, 2)


def test_what_is_let_go_while_nothing_comes_is_given_back() -> None:
    unused = UnusedMemory(OWN)
    size = 100 * 2**20
    assert not unused.is_due(OWN + size, size, 1)
    assert not unused.is_due(OWN + size, size, 1)
    assert unused.is_due(OWN + size, 0, 1)


_FRAGMENTED = """
import psutil
from rce.ros.tcpros.allocator import give_back_free_memory, keep_large_blocks
keep_large_blocks()
blocks = [b"x" * 10_000_000 for _ in range(30)]
last = blocks.pop()
blocks.clear()
before = psutil.Process().memory_info().rss
given = give_back_free_memory()
print(given, before - psutil.Process().memory_info().rss)
"""


def test_free_memory_below_a_used_block_is_given_back() -> None:
    """The threshold of the allocator does not see it."""
    out = subprocess.run([sys.executable, "-c", _FRAGMENTED], capture_output=True, text=True, check=True)
    given, size = out.stdout.split()
    assert given == "True"
    assert int(size) > 250_000_000
