"""Figures from readings and stamps, computed by hand beside."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from rce_fleet.experiments.bench import CLIENT, Bench, Reading
from rce_fleet.experiments.machines import Traffic
from rce_fleet.experiments.measures import Sample, by_topic, delivered, over_time, used
from rce_fleet.experiments.streaming import Part, Streaming
from rce_fleet.experiments.usage import Usage
from rce_fleet.experiments.workloads.control import QUIET

MICRO = 1_000_000


def reading(at: float, cpu_s: float, sent: int, received: int, packets: int = 0) -> Reading:
    return Reading(at, Usage(cpu_s, 1000), Traffic(sent, received, packets, 2 * packets))


def figures(values: object) -> dict[str, float]:
    assert isinstance(values, list)
    return {value.metric: value.value for value in values}


def test_what_a_machine_used_is_per_second() -> None:
    found = figures(used("server", reading(10.0, 1.0, 100, 1000), reading(14.0, 3.0, 500, 9000, 8)))
    assert found == {
        "server.cpu": 0.5,
        "server.network_out": 100.0,
        "server.network_in": 2000.0,
        "server.packets_out": 2.0,
        "server.packets_in": 4.0,
        "server.memory": 1000.0,
    }


def test_the_network_over_time_counts_both_directions() -> None:
    readings = [reading(10.0, 0, 0, 0), reading(10.5, 0, 100, 400), reading(11.5, 0, 300, 1200)]
    assert figures(over_time(readings, [0.5, 1.5])) == {
        "server.network@0.5": 1000.0,
        "server.network@1.5": 1000.0,
    }


def test_only_what_is_inside_the_window_counts() -> None:
    sent = {"/a": [9 * MICRO, 10 * MICRO, 11 * MICRO], "/b": [10 * MICRO, 13 * MICRO]}
    received = {
        "/a": [Sample(9 * MICRO, 10 * MICRO), Sample(10 * MICRO, 10 * MICRO + 200_000)],
        "/b": [Sample(10 * MICRO, 10 * MICRO + 400_000), Sample(13 * MICRO, 13 * MICRO + 1)],
    }
    found = figures(delivered(sent, received, (10.0, 12.0), 6000.0))
    assert found["rate"] == pytest.approx(3 / 2 / 2)
    assert found["received"] == pytest.approx(3 / 2 / 2)
    assert found["delay_p50"] == pytest.approx(0.4)
    assert found["message_bytes"] == pytest.approx(2000.0)
    assert found["lost"] == pytest.approx(1 / 3), "one of /a's two, none of /b's one"


def test_messages_that_may_be_under_way_are_not_lost() -> None:
    found = figures(delivered({"/a": [10 * MICRO, 11 * MICRO + 800_000]}, {}, (10.0, 12.0), 0.0))
    assert found["lost"] == 1.0
    assert "lost" not in figures(delivered({"/a": [11 * MICRO + 800_000]}, {}, (10.0, 12.0), 0.0))
    assert "delay_p50" not in found, "nothing arrived"


def test_samples_are_told_in_several_reports() -> None:
    reports: list[dict[str, object]] = [
        {"phase": "1", "topic": "/a", "samples": [[1, 2]]},
        {"phase": "2", "topic": "/a", "samples": [[5, 6]]},
        {"phase": "1", "topic": "/a", "samples": [[3, 4]]},
        {"phase": "end"},
    ]
    assert by_topic(reports, "1") == {"/a": [(1, 2), (3, 4)]}


class SlowBench:
    """Machines whose meters take a while to be read, as on a small computer."""

    def __init__(self) -> None:
        self.meters = {CLIENT: SimpleNamespace(limits=False)}
        self.read_s = iter([0.02, 0.09, 0.12, 0.06, 0.11, 0.08, 0.05, 0.1])

    async def read(self, machine: str) -> Reading:
        del machine
        await asyncio.sleep(next(self.read_s))
        return reading(time.time(), 0.0, 0, 0)

    async def emulation_s(self) -> float:
        return 0.0

    def check(self) -> None:
        pass


@pytest.mark.slow
async def test_runs_are_read_at_the_same_times(tmp_path: Path) -> None:
    """Each value over time has a column: one that is read at 1.1 s is not compared with one at 1.0 s."""
    streaming = Streaming(cast("Bench", SlowBench()), tmp_path / "control.json", [], [])
    ((_, values),) = await streaming.measure([Part({}, QUIET, 30.0)], 1.2)
    metrics = [value.metric for value in values if "@" in value.metric]
    assert metrics == ["server.network@0.5", "server.network@1.0", "server.network@1.2"]
