"""The experiments' programs in C++: they print and tell as those in Python do, and experiments run them."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
from collections import Counter
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from support.experiments import left_behind
from support.processes import finish
from support.ros_real import Graph, our_graph
from support.roscpp_programs import run_folder

from rce_fleet.experiments.experiment import Experiment, Options, Trial
from rce_fleet.experiments.images import JPEG, RAW, write_images
from rce_fleet.experiments.laser import Laser
from rce_fleet.experiments.measures import by_topic
from rce_fleet.experiments.round_trip import QUICK_TRIPS, RoundTrip
from rce_fleet.experiments.systems.software import ROS, ROSCPP, Software
from rce_fleet.experiments.workloads.control import END, PRINTED, Phase, give
from rce_fleet.experiments.workloads.telling import READY, REPORT, reports

pytestmark = pytest.mark.needs("roscpp_sensor_msgs", "rospy", "roslaunch")

TIMEOUT_S = 120.0
FEW = 4
WORK_S = 0.05
"""Processor time that a message takes: more than all the rest of the program."""
STAMP = re.compile(r"secs: *(\d+)")
FIELD = re.compile(r"^\w+:", re.MULTILINE)
"""Messages of each topic that are printed."""


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """The programs, compiled once in a test run and not kept for the next one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(run_folder()))
        ROSCPP.prepare(print)


class Started:
    """A program with its output in a file."""

    def __init__(self, output: Path, pid: int) -> None:
        self._output = output
        self._pid = pid

    def cpu_s(self) -> float:
        """Processor time so far, seconds."""
        fields = Path(f"/proc/{self._pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")

    def lines(self) -> list[str]:
        text = self._output.read_text()
        return text[: text.rfind("\n") + 1].splitlines()

    def has_ended(self) -> bool:
        told = list(reports(self.lines()))
        return bool(told) and told[-1] == {"phase": END}

    def samples(self) -> dict[str, list[tuple[int, ...]]]:
        return by_topic(reports(self.lines()), "0")

    def messages(self) -> dict[tuple[str, ...], str]:
        """What was printed of each message, by its fields and stamp.

        Sequence numbers are left out: a listener's begin when it was connected. So are empty lines: a report
        begins with one.
        """
        left_out = (READY, REPORT, "  seq: ")
        printed = [line for line in self.lines() if line and not line.startswith(left_out)]
        *texts, _ = ("\n" + "\n".join(printed)).split("---")
        return {(*STAMP.findall(text), *FIELD.findall(text)): text for text in texts}


@contextlib.asynccontextmanager
async def started(
    graph: Graph, software: Software, program: str, *words: str | Path
) -> AsyncIterator[Started]:
    output = graph.home / f"{program}-{software.name}.log"
    with output.open("wb") as file:
        process = await asyncio.create_subprocess_exec(
            *(*software.workload(program), *map(str, words)),
            env=graph.env | dict(software.environ(graph.home)),
            stdout=file,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        yield Started(output, process.pid)
    finally:
        await finish(process)


async def until(condition: Callable[[], bool], shown: Callable[[], object]) -> None:
    try:
        async with asyncio.timeout(TIMEOUT_S):
            while not condition():
                await asyncio.sleep(0.05)
    except TimeoutError:
        raise AssertionError(f"not within {TIMEOUT_S:g} s: {shown()}") from None


async def test_programs_print_and_tell_as_those_in_python(tmp_path: Path) -> None:
    """Listeners of both languages take what the C++ programs send, and print and tell the same."""
    control, images = tmp_path / "control.json", tmp_path / "images.jsonl"
    write_images(images, [JPEG, RAW], ["160x120"])
    kinds = {
        "/Robot7/scan": "sensor_msgs/LaserScan",
        "/camera/image_raw": "sensor_msgs/Image",
        "/camera/image_raw/compressed": "sensor_msgs/CompressedImage",
    }
    topics = [f"{topic}={kind}" for topic, kind in kinds.items()]
    async with (
        our_graph(tmp_path) as graph,
        started(graph, ROSCPP, "listener", *topics) as listener,
        started(graph, ROS, "listener", *topics) as reference,
        started(graph, ROSCPP, "robots", "--control", control, "7") as robots,
        started(graph, ROSCPP, "camera", "--control", control, "--images", images) as camera,
    ):
        everyone = (listener, reference, robots, camera)
        await until(lambda: all(READY in one.lines() for one in (listener, reference)), listener.lines)
        before = robots.cpu_s()
        give(control, Phase("0", PRINTED, 5.0, work_s=WORK_S))
        await until(
            lambda: all(one.lines().count("---") >= FEW * len(kinds) for one in (listener, reference)),
            lambda: [one.lines()[-5:] for one in everyone],
        )
        assert robots.cpu_s() - before > (FEW - 1) * WORK_S  # the kernel tells whole ticks
        give(control, Phase("end", END))
        await until(
            lambda: all(one.has_ended() for one in everyone), lambda: [one.lines()[-5:] for one in everyone]
        )
        sent = robots.samples() | camera.samples()
        assert sent.keys() == kinds.keys()
        ours, theirs = listener.messages(), reference.messages()
        both = ours.keys() & theirs.keys()  # a queue that is full on a busy machine loses some
        by_kind = Counter(key[2:] for key in both)
        assert len(by_kind) == len(kinds)
        assert {key: ours[key] for key in both} == {key: theirs[key] for key in both}
        for found in (listener.samples(), reference.samples()):
            assert found.keys() == kinds.keys()
            for topic, samples in found.items():
                assert {one[:1] for one in samples} <= set(sent[topic])
                assert all(stamp <= arrival for stamp, arrival in samples)


async def measured(experiment: Experiment, options: Options) -> dict[str, list[float]]:
    """Run an experiment's last set-up; return its values by metric."""
    setup = experiment.setups(options)[-1]
    found: dict[str, list[float]] = {}
    for one in await experiment.measure(Trial(setup, options, seed=1)):
        assert one.condition.software == "roscpp"
        found.setdefault(one.value.metric, []).append(one.value.value)
    assert left_behind(os.getpid()) == []
    return found


@pytest.mark.needs("netns")
@pytest.mark.parametrize("system", ["single_master", "cloud"])
async def test_experiments_are_done_with_them(system: str) -> None:
    options = Options(systems=(system,), software=("roscpp",), robots=2, seconds=1.0, quick=True)
    trips = await measured(RoundTrip(), options)
    assert len(trips["round_trip"]) == len(trips["lost"]) >= len(QUICK_TRIPS)
    assert min(trips["round_trip"]) > 0.009, "twice the link's delay"
    scans = await measured(Laser(), options)
    assert scans.keys() >= {"rate", "received", "delay_p50", "server.cpu", "client.cpu"}
    assert min(scans["received"]) > 0
    assert min(scans["delay_p50"]) > 0.004
