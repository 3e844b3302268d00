"""Figures from readings and stamps, computed by hand beside."""

from __future__ import annotations

import asyncio
import json
import time
from itertools import cycle
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from rce_fleet.experiments.bench import CLIENT, Bench, Reading
from rce_fleet.experiments.machines import Traffic
from rce_fleet.experiments.measures import Sample, by_topic, delivered, lasted, message_bytes, over_time, used
from rce_fleet.experiments.streaming import Part, Streaming
from rce_fleet.experiments.systems.base import RunningWorkload
from rce_fleet.experiments.usage import Usage
from rce_fleet.experiments.workloads.control import NOTHING, QUIET, Control, Phase
from rce_fleet.experiments.workloads.telling import REPORT

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
    found = figures(delivered(sent, received, (10.0, 12.0)))
    assert found["rate"] == pytest.approx(3 / 2 / 2)
    assert found["received"] == pytest.approx(3 / 2 / 2)
    assert found["delay_p50"] == pytest.approx(0.4)
    assert figures(message_bytes(received, (10.0, 12.0), 6000.0)) == {"message_bytes": 2000.0}
    assert message_bytes(received, (20.0, 22.0), 6000.0) == []
    assert found["lost"] == pytest.approx(1 / 3), "one of /a's two, none of /b's one"


def test_messages_that_may_be_under_way_are_not_lost() -> None:
    found = figures(delivered({"/a": [10 * MICRO, 11 * MICRO + 800_000]}, {}, (10.0, 12.0)))
    assert found["lost"] == 1.0
    assert "lost" not in figures(delivered({"/a": [11 * MICRO + 800_000]}, {}, (10.0, 12.0)))
    assert "delay_p50" not in found, "nothing arrived"


@pytest.mark.parametrize(("count", "is_told"), [(19, False), (20, True)])
def test_few_delays_have_no_late_percentiles(count: int, is_told: bool) -> None:
    """They would be the largest delay, twice."""
    received = {"/a": [Sample(10 * MICRO, 10 * MICRO + number) for number in range(count)]}
    found = figures(delivered({"/a": []}, received, (10.0, 12.0)))
    assert "delay_p50" in found
    assert ("delay_p95" in found) == ("delay_p99" in found) == is_told


def test_messages_last_as_long_as_they_are_sent_or_arrive() -> None:
    arrivals = [12_400_000, 14_400_000, 16_400_000]
    received = {"/a": [Sample(arrival - 2_400_000, arrival) for arrival in arrivals]}
    assert lasted(received, 6.0) == pytest.approx(6.0), "how late they come makes no difference"
    assert lasted({"/a": [Sample(0, 3 * one) for one in arrivals]}, 6.0) == pytest.approx(18.0)
    assert lasted({"/a": received["/a"][:1]}, 6.0) == lasted({}, 6.0) == 6.0


def test_whole_parts_have_whole_periods() -> None:
    assert Part({}, QUIET, 0.5, is_whole=True).seconds(3.0) == 6.0
    assert Part({}, QUIET, 3.0, is_whole=True).seconds(3.0) == 3.0
    assert Part({}, QUIET, 0.5).seconds(3.0) == 3.0


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
        self.read_s = cycle([0.02, 0.09, 0.12, 0.06, 0.11, 0.08, 0.05, 0.1])

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


SIZE = 1_000_000
CARRY_S, WORK_S = 0.1, 0.15


class Pipe:
    """A source, a link and a listener; each message is carried, and then worked on, for a while."""

    def __init__(self, control: Path) -> None:
        self.meters = {CLIENT: SimpleNamespace(limits=False)}
        self.control = Control(control)
        self.messages: list[tuple[str, float, float]] = []
        """Phase, when it was sent, and when the link began to carry it."""
        self.early: list[str] = []
        """Phases that began while messages were under way."""

    async def run(self) -> None:
        phase, due = Phase(), 0.0
        while True:
            given, now = self.control.read(), time.time()
            if given != phase:
                phase, due = given, now
                if phase.stream != NOTHING and now < self.free + WORK_S:
                    self.early.append(phase.name)
            if now >= due and phase.stream != NOTHING and not phase.is_small:
                self.messages.append((phase.name, now, max(now, self.free)))
                due += 1 / phase.rate
            await asyncio.sleep(0.005)

    @property
    def free(self) -> float:
        """When the link has carried all."""
        return self.messages[-1][2] + CARRY_S if self.messages else 0.0

    async def read(self, machine: str) -> Reading:
        del machine
        now = time.time()
        ages = [now - begin for _, _, begin in self.messages]
        carried = sum(SIZE * min(1.0, max(0.0, age / CARRY_S)) for age in ages)
        worked = sum(min(WORK_S, max(0.0, age - CARRY_S)) for age in ages)
        return reading(now, worked, 0, round(carried))

    async def emulation_s(self) -> float:
        return 0.0

    def check(self) -> None: ...

    async def wait_ready(self) -> None: ...

    async def lines(self) -> list[str]:
        samples: dict[str, list[tuple[int, int]]] = {}
        for phase, sent, begin in self.messages:
            arrival = begin + CARRY_S + WORK_S
            samples.setdefault(phase, []).append((int(sent * MICRO), int(arrival * MICRO)))
        told = [{"phase": phase, "topic": "/a", "samples": found} for phase, found in samples.items()]
        return [f"{REPORT}{json.dumps(report)}" for report in (*told, {"phase": "end"})]


async def test_a_part_begins_once_the_last_ones_messages_arrived(tmp_path: Path) -> None:
    """All bytes and all work of a part belong to its messages, also of few large ones."""
    control = tmp_path / "control.json"
    pipe = Pipe(control)
    source = asyncio.create_task(pipe.run())
    programs = [cast("RunningWorkload", pipe)]
    streaming = Streaming(cast("Bench", pipe), control, programs, programs)
    whole, above = Part({}, QUIET, 5.0, is_whole=True), Part({}, QUIET, 12.0)
    found = await streaming.measure([whole, whole, above], 0.5)
    source.cancel()
    assert pipe.early == []
    assert {phase for phase, _, _ in pipe.messages} == {"0", "1", "2"}
    for part, values in found:
        value = figures(values)
        assert value["message_bytes"] == pytest.approx(SIZE)
        if part.is_whole:
            assert value["server.cpu"] / value["received"] == pytest.approx(WORK_S)
