"""What a process reports of itself, against another source."""

from __future__ import annotations

import mmap

import psutil

from rce.own_process import cpu_seconds, machine_memory, resident_bytes

MB = 1_000_000


def test_machine_memory_is_that_of_the_kernel() -> None:
    assert machine_memory() == psutil.virtual_memory().total


def test_resident_bytes_grow_with_what_is_used() -> None:
    before = resident_bytes()
    with mmap.mmap(-1, 64 * MB) as block:  # of the heap, some may be free
        block.write(b"x" * len(block))
        assert resident_bytes() - before > 60 * MB
        resident = psutil.Process().memory_info().rss
        assert abs(resident_bytes() - resident) < MB


def test_cpu_seconds_are_those_of_the_process() -> None:
    first = cpu_seconds()
    times = psutil.Process().cpu_times()
    tick = 0.02  # the kernel tells each of the two in whole hundredths
    assert first - tick <= times.user + times.system <= cpu_seconds() + tick
