"""The programs of the experiments, with a graph that is driven by hand: what they send, tell and print."""

from __future__ import annotations

import io
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rce_fleet.experiments.measures import by_topic
from rce_fleet.experiments.workloads.asker import Asker
from rce_fleet.experiments.workloads.camera import streams_of
from rce_fleet.experiments.workloads.control import END, PRINTED, QUIET, Phase, give
from rce_fleet.experiments.workloads.graph import Stamp
from rce_fleet.experiments.workloads.listener import Listener
from rce_fleet.experiments.workloads.robots import RAYS, scans
from rce_fleet.experiments.workloads.source import LOOK_S, Source, Stream
from rce_fleet.experiments.workloads.telling import LONGEST, READY, reports, tell, tell_ready, tell_samples

SEC = 1_000_000_000


class Graph:
    """Keeps what was sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Mapping[str, Any], Stamp | None]] = []

    def output(self, topic: str, kind: str) -> Sent:
        del kind
        return Sent(self, topic)

    def take(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        raise AssertionError(f"nothing is to be taken, not {topic} of {kind} by {callback}")

    def provide(self, service: str, kind: str, answer: Callable[[], Mapping[str, Any]]) -> None:
        raise AssertionError(f"nothing is to be provided, not {service} of {kind} by {answer}")

    def call(self, service: str, kind: str, callback: Callable[[Any], None]) -> None:
        raise AssertionError(f"nothing is to be called, not {service} of {kind} for {callback}")

    def run(self, step: Callable[[], float]) -> None:
        raise AssertionError(f"driven by hand, not by {step}")


class Sent:
    def __init__(self, graph: Graph, topic: str) -> None:
        self._graph = graph
        self._topic = topic

    def send(self, fields: Mapping[str, Any], stamp: Stamp | None = None) -> None:
        self._graph.sent.append((self._topic, fields, stamp))


def message(ns: int, frame: str) -> SimpleNamespace:
    stamp = SimpleNamespace(secs=ns // SEC, nsecs=ns % SEC)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp, frame_id=frame))


def numbered() -> Iterator[Mapping[str, Any]]:
    return ({"number": number} for number in count())


def told(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    found = reports(capsys.readouterr().out.splitlines())
    return [report for report in found if READY not in report]


def test_a_source_sends_each_stream_at_the_rate_and_tells_it_after_the_phase(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    graph, control = Graph(), tmp_path / "control.json"
    streams = [Stream(topic, topic, "a/B", numbered(), {"last": 1}) for topic in ("/a", "/b")]
    source = Source(graph, streams, control)
    assert 0 < source.step() <= LOOK_S
    assert [(topic, fields) for topic, fields, _ in graph.sent] == [("/a", {"last": 1}), ("/b", {"last": 1})]
    assert {stamp.frame for _, _, stamp in graph.sent if stamp} == {"start/quiet"}

    give(control, Phase("1", PRINTED, 10.0, "/b"))
    time.sleep(LOOK_S)
    source.step()
    topic, fields, stamp = graph.sent[-1]
    assert (topic, fields["number"]) == ("/b", 0)
    assert stamp is not None
    assert stamp.frame == "1/printed"
    assert told(capsys) == [], "what was sent before the first phase is of no interest"

    give(control, Phase("end", END))
    time.sleep(LOOK_S)
    source.step()
    assert graph.sent[-1][1] == {"last": 1}
    found = told(capsys)
    assert by_topic(found, "1") == {"/b": [(stamp.ns // 1000,)]}
    assert found[-1] == {"phase": END}


def test_a_source_works_for_each_message_and_sends_one_at_a_time(tmp_path: Path) -> None:
    graph, control = Graph(), tmp_path / "control.json"
    streams = [Stream(topic, topic, "a/B", numbered(), {}) for topic in ("/a", "/b")]
    give(control, Phase("1", PRINTED, 1e-3, work_s=0.01))
    source = Source(graph, streams, control)
    for topic in ("/a", "/b"):
        before = time.thread_time()
        source.step()
        assert time.thread_time() - before >= 0.01
        assert graph.sent[-1][0] == topic
    assert len(graph.sent) == len(streams)
    source.step()
    assert len(graph.sent) == len(streams), "the next message is due later"


def test_a_listener_is_ready_when_it_has_heard_all_and_tells_when_all_have_ended(
    capsys: pytest.CaptureFixture[str],
) -> None:
    listener = Listener(["/a", "/b"])
    listener.take("/a", message(5 * SEC, f"1/{QUIET}"))
    assert capsys.readouterr().out == ""
    listener.take("/b", message(6 * SEC, f"1/{PRINTED}"))
    out = capsys.readouterr().out
    assert "frame_id='1/printed'" in out
    *printed, ready, report = filter(None, out.splitlines())
    assert printed[-1] == "---"
    assert ready == READY
    assert abs(next(reports([report]))[READY] - time.time()) < SEC
    listener.take("/a", message(7 * SEC, f"end/{END}"))
    assert told(capsys) == [], "/b may have messages under way"
    listener.take("/b", message(7 * SEC, f"end/{END}"))
    listener.take("/b", message(8 * SEC, f"end/{END}"))
    found = told(capsys)
    assert [one[0] for one in by_topic(found, "1")["/a"]] == [5_000_000]
    assert found[-1] == {"phase": END}
    assert len(found) == 3


def test_long_lists_are_told_in_several_lines(capsys: pytest.CaptureFixture[str]) -> None:
    samples: list[tuple[int, ...]] = [(number,) for number in range(2 * LONGEST + 1)]
    tell_samples("1", "/a", samples)
    found = told(capsys)
    assert len(found) == 3
    assert by_topic(found, "1")["/a"] == samples


def test_an_asker_counts_trips_after_the_first_of_each_small_size(capsys: pytest.CaptureFixture[str]) -> None:
    graph = Graph()
    asker = Asker(graph.output("/there", ""), [(7, 2), (200_000, 1)], patience=60.0)
    asker.step()
    sizes = []
    for _ in range(5):
        text = graph.sent[-1][1]["data"]
        sizes.append(len(text))
        asker.take(SimpleNamespace(data="another"))
        asker.take(SimpleNamespace(data=text))
    assert sizes == [7, 7, 7, 7, 200_000], "one to see who is there, one to warm up, two; one"
    found = told(capsys)
    assert [(one["bytes"], len(one["trips"]), one["lost"]) for one in found[:-1]] == [
        (7, 2, 0),
        (200_000, 1, 0),
    ]
    assert found[-1] == {"phase": "end"}


def test_a_message_that_does_not_come_back_is_lost(capsys: pytest.CaptureFixture[str]) -> None:
    graph = Graph()
    asker = Asker(graph.output("/there", ""), [(1_000_000, 1)], patience=0.0)
    asker.step()
    asker.take(SimpleNamespace(data=graph.sent[-1][1]["data"]))
    time.sleep(0.001)
    asker.step()
    assert told(capsys) == [{"bytes": 1_000_000, "trips": [], "lost": 1}, {"phase": "end"}]


def test_lines_of_threads_do_not_mix(monkeypatch: pytest.MonkeyPatch) -> None:
    class Slow(io.StringIO):
        def write(self, text: str) -> int:
            for one in text:
                super().write(one)
                time.sleep(0)  # another thread's turn
            return len(text)

    slow = Slow()
    monkeypatch.setattr(sys, "stdout", slow)
    with ThreadPoolExecutor(4) as pool:
        for number in range(100):
            pool.submit(tell, {"number": number})
            pool.submit(tell_ready)
    lines = slow.getvalue().splitlines()
    assert lines.count(READY) == 100
    assert {report["number"] for report in reports(lines) if READY not in report} == set(range(100))


def test_a_report_is_read_after_half_a_line_on_standard_error(tmp_path: Path) -> None:
    program = (
        "import sys\n"
        "from rce_fleet.experiments.workloads.telling import tell, tell_ready\n"
        "sys.stderr.write('unable to contact master')\n"
        "tell({'number': 1})\n"
        "sys.stderr.write('service unavailable')\n"
        "tell_ready()\n"
    )
    output = tmp_path / "both.log"
    with output.open("ab") as file:
        subprocess.run(
            [sys.executable, "-u", "-c", program], check=True, stdout=file, stderr=subprocess.STDOUT
        )
    lines = output.read_text().splitlines()
    assert READY in lines
    assert [report for report in reports(lines) if READY not in report] == [{"number": 1}]


def test_scans_have_the_kinects_rays_and_differ() -> None:
    robot = scans(1)
    first, second = next(robot)["ranges"], next(robot)["ranges"]
    assert len(first) == RAYS
    assert first != second
    assert next(scans(2))["ranges"] != first


def test_a_camera_reads_its_images(tmp_path: Path) -> None:
    (tmp_path / "one").write_bytes(b"\1\2\3")
    (tmp_path / "images.jsonl").write_text(
        '{"stream": "s", "topic": "/t", "type": "sensor_msgs/Image", "fields": {"width": 1}, "file": "one"}\n'
    )
    (stream,) = streams_of(tmp_path / "images.jsonl")
    assert next(stream.messages) == {"width": 1, "data": b"\1\2\3"}
    assert stream.last["data"] == bytes(3)
