"""Percentiles and the memory of the benchmarks."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, cast

import pytest

from benchmarks.figures import percentile
from benchmarks.ros.programs import ours

if TYPE_CHECKING:
    from rce.ros.node import Node

ROOT = Path(__file__).parents[2]
TOUCHED = 300_000_000
"""Bytes of a process that starts a measurement."""


@pytest.mark.parametrize(
    ("values", "share", "found"),
    [
        ([2.0, 1.0], 0.5, 1.0),
        ([3.0, 1.0, 2.0], 0.5, 2.0),
        ([float(number) for number in range(1, 101)], 0.95, 95.0),
        ([float(number) for number in range(1, 101)], 0.07, 7.0),
        ([3.0, 1.0, 2.0], 0.0, 1.0),
        ([3.0, 1.0, 2.0], 1.0, 3.0),
    ],
)
def test_percentile_is_the_nearest_rank(values: list[float], share: float, found: float) -> None:
    assert percentile(values, share) == found


def test_percentile_refuses_percents() -> None:
    with pytest.raises(AssertionError, match="50 is not a share"):
        percentile([1.0, 2.0], 50)


def test_memory_of_light_robots_below_a_large_parent() -> None:
    """The peak that the kernel reports of a new program begins with the size of the one that started it."""
    code = "from benchmarks.light import measure_world; print(measure_world(1000, 1.0)['MB more'])"
    assert 0 < below_a_large_parent(code) < TOUCHED / 1e6


def test_peak_of_a_process_begins_with_its_program() -> None:
    code = "from benchmarks.figures import own_memory; print(own_memory('VmHWM'))"
    assert 0 < below_a_large_parent(code) < TOUCHED / 1e6


class CountedCalls:
    """A node whose calls of services are counted."""

    def __init__(self) -> None:
        self.under_way = self.most = 0

    async def wait_for_service(self, name: str, *, timeout: float) -> None:
        pass

    def service_client(self, name: str, kind: str, *, persistent: bool = True) -> CountedCalls:
        return self

    async def __call__(self, *, data: bool) -> None:
        self.under_way += 1
        self.most = max(self.most, self.under_way)
        await asyncio.sleep(0)
        self.under_way -= 1


async def test_service_calls_are_measured_in_flight(capsys: pytest.CaptureFixture[str]) -> None:
    node = CountedCalls()
    await ours.call(cast("Node", node), "0.01")
    found = json.loads(capsys.readouterr().out)
    assert found.keys() == {"persistent", "single", "32 in flight"}
    assert node.most == 32
    assert min(found.values()) > 0


def below_a_large_parent(code: str) -> float:
    """Return the number that a program prints which a process of 300 MB starts."""
    touched = b"x" * TOUCHED
    argv = [sys.executable, "-c", code]
    done = subprocess.run(argv, cwd=ROOT, capture_output=True, text=True, check=True)
    assert len(touched) == TOUCHED
    return float(done.stdout)
